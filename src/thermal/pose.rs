//! What is known of the camera at exposure, and how it sits in the vehicle. FRD axes, ZYX angles.

use super::FrameError;
use nalgebra::{Matrix3, Rotation3};
use serde::{Deserialize, Serialize};

/// What is known of the camera at exposure. `None` means unknown, never zero.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Pose {
    /// Height of the camera above ground, metres.
    pub agl_m: Option<f64>,
    /// Ground metres per frame pixel at nadir; wins over `agl_m` with the field of view.
    pub gsd_m: Option<f64>,
    /// Horizontal field of view, degrees.
    pub hfov_deg: Option<f64>,
    /// Of the camera: clockwise from true north to image up, degrees.
    pub yaw_deg: Option<f64>,
    /// Of the camera: nose up positive, the axis swings forward; 0 is nadir. Degrees.
    pub pitch_deg: Option<f64>,
    /// Of the camera: right side down positive. Degrees.
    pub roll_deg: Option<f64>,
}

/// How the camera sits in the vehicle: the rotation from vehicle attitude to the camera's. FRD, ZYX.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraModel {
    /// Horizontal field of view used where a frame states none, degrees.
    pub hfov_deg: Option<f64>,
    /// Mount roll, degrees.
    pub mount_roll_deg: f64,
    /// Mount pitch, degrees.
    pub mount_pitch_deg: f64,
    /// Mount yaw, degrees.
    pub mount_yaw_deg: f64,
}

impl CameraModel {
    /// Vehicle attitude in `pose` -> camera attitude, by the mount's rotation: `R_camera = R_vehicle R_mount`. The field of
    /// view is filled in where the pose states none.
    ///
    /// Without a yaw the camera has none. Where the vehicle's pitch or roll is unknown it counts as level, and the mount's tilt
    /// is the camera's; how well that is known is [`Pose::tilt_known`] of the vehicle's pose, not of what comes out. The
    /// camera's yaw comes out in 0..360.
    pub fn camera_pose(&self, pose: &Pose) -> Pose {
        let pose = Pose { hfov_deg: pose.hfov_deg.or(self.hfov_deg), ..*pose };
        let mount = Attitude { yaw_deg: self.mount_yaw_deg, pitch_deg: self.mount_pitch_deg, roll_deg: self.mount_roll_deg };
        if mount == Attitude::default() {
            return pose;
        }
        let vehicle = Attitude {
            yaw_deg: pose.yaw_deg.unwrap_or(0.0),
            pitch_deg: pose.pitch_deg.unwrap_or(0.0),
            roll_deg: pose.roll_deg.unwrap_or(0.0),
        };
        let camera = Attitude::of_rotation(&(vehicle.rotation() * mount.rotation()));
        let tilted = pose.pitch_deg.is_some() || pose.roll_deg.is_some() || mount.pitch_deg != 0.0 || mount.roll_deg != 0.0;
        Pose {
            yaw_deg: pose.yaw_deg.map(|_| camera.yaw_deg),
            pitch_deg: tilted.then_some(camera.pitch_deg),
            roll_deg: tilted.then_some(camera.roll_deg),
            ..pose
        }
    }
}

impl Pose {
    /// Whether pitch and roll are both given.
    pub fn tilt_known(&self) -> bool {
        self.pitch_deg.is_some() && self.roll_deg.is_some()
    }

    /// Ground under `side_px` pixels at nadir, metres, of a frame `width_px` wide; `None` where height and field of view do
    /// not say.
    pub fn footprint_m(&self, side_px: u32, width_px: u32) -> Option<f64> {
        let width_m = || Some(2.0 * self.agl_m? * (self.hfov_deg? / 2.0).to_radians().tan());
        let gsd_m = self.gsd_m.or_else(|| Some(width_m()? / f64::from(width_px)))?;
        Some(gsd_m * f64::from(side_px))
    }

    /// Whether every known number is finite and within what can be flown.
    pub(super) fn check(&self) -> Result<(), FrameError> {
        for (name, value, least, most) in [
            ("agl_m", self.agl_m, 0.1, 20_000.0),
            ("gsd_m", self.gsd_m, 0.001, 100.0),
            ("hfov_deg", self.hfov_deg, 1.0, 150.0),
            ("yaw_deg", self.yaw_deg, -360.0, 360.0),
            ("pitch_deg", self.pitch_deg, -360.0, 360.0),
            ("roll_deg", self.roll_deg, -360.0, 360.0),
        ] {
            if let Some(value) = value {
                in_range(name, value, least, most)?;
            }
        }
        Ok(())
    }
}

/// A camera's or vehicle's attitude: FRD body axes against NED, ZYX, degrees.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Attitude {
    pub yaw_deg: f64,
    pub pitch_deg: f64,
    pub roll_deg: f64,
}

impl Attitude {
    /// Body (FRD) -> NED: `Rz(yaw) Ry(pitch) Rx(roll)`.
    pub fn rotation(&self) -> Matrix3<f64> {
        let (roll, pitch, yaw) = (self.roll_deg.to_radians(), self.pitch_deg.to_radians(), self.yaw_deg.to_radians());
        Rotation3::from_euler_angles(roll, pitch, yaw).into_inner()
    }

    /// The inverse of [`Attitude::rotation`], with the yaw in 0..360.
    pub fn of_rotation(to_ned: &Matrix3<f64>) -> Self {
        let yaw_deg = to_ned.m21.atan2(to_ned.m11).to_degrees();
        Self {
            yaw_deg: if yaw_deg < 0.0 { yaw_deg + 360.0 } else { yaw_deg },
            pitch_deg: (-to_ned.m31).atan2(to_ned.m32.hypot(to_ned.m33)).to_degrees(),
            roll_deg: to_ned.m32.atan2(to_ned.m33).to_degrees(),
        }
    }

    /// Angle between the body's down axis and the vertical, degrees, 0..=180.
    pub fn tilt_deg(&self) -> f64 {
        let down = self.rotation().column(2).into_owned();
        down[0].hypot(down[1]).atan2(down[2]).to_degrees()
    }
}

/// An error for a field.
pub(super) fn field(field: &'static str, expected: String, found: String) -> FrameError {
    FrameError::Field { field, expected, found }
}

/// `least ..= most`; NaN is outside.
pub(super) fn in_range(name: &'static str, value: f64, least: f64, most: f64) -> Result<(), FrameError> {
    if (least..=most).contains(&value) { Ok(()) } else { Err(field(name, format!("{least} to {most}"), value.to_string())) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pose(yaw_deg: f64, pitch_deg: f64, roll_deg: f64) -> Pose {
        Pose { yaw_deg: Some(yaw_deg), pitch_deg: Some(pitch_deg), roll_deg: Some(roll_deg), ..Pose::default() }
    }

    fn close(found: Option<f64>, expected: f64) -> bool {
        found.is_some_and(|found| ((found - expected + 540.0).rem_euclid(360.0) - 180.0).abs() < 1e-9)
    }

    #[test]
    fn mounts_by_hand() {
        // Turned by 90 degrees, the vehicle's nose is on the camera's left: nose up is right side down.
        let turned = CameraModel { mount_yaw_deg: 90.0, ..CameraModel::default() };
        let camera = turned.camera_pose(&pose(10.0, 5.0, 0.0));
        assert!(close(camera.yaw_deg, 100.0) && close(camera.pitch_deg, 0.0) && close(camera.roll_deg, 5.0), "{camera:?}");
        let camera = turned.camera_pose(&pose(300.0, 0.0, 7.0));
        assert!(close(camera.yaw_deg, 30.0) && close(camera.pitch_deg, -7.0) && close(camera.roll_deg, 0.0), "{camera:?}");
        // Tilted forward by 10 degrees in a vehicle that pitches 5 degrees down.
        let tilted = CameraModel { mount_pitch_deg: 10.0, ..CameraModel::default() };
        let camera = tilted.camera_pose(&pose(0.0, -5.0, 0.0));
        assert!(close(camera.pitch_deg, 5.0) && close(camera.roll_deg, 0.0), "{camera:?}");
    }

    #[test]
    fn unknown_stays_unknown() {
        let none = CameraModel { hfov_deg: Some(40.0), ..CameraModel::default() };
        assert_eq!(none.camera_pose(&Pose::default()), Pose { hfov_deg: Some(40.0), ..Pose::default() });
        let stated = Pose { hfov_deg: Some(30.0), ..pose(1.0, 2.0, 3.0) };
        assert_eq!(none.camera_pose(&stated), stated);
        let turned = CameraModel { mount_yaw_deg: 90.0, ..none };
        let camera = turned.camera_pose(&Pose { yaw_deg: Some(45.0), ..Pose::default() });
        assert!(close(camera.yaw_deg, 135.0) && camera.pitch_deg.is_none() && camera.roll_deg.is_none(), "{camera:?}");
        assert_eq!(turned.camera_pose(&Pose { pitch_deg: Some(3.0), ..Pose::default() }).yaw_deg, None);
        let tilted = CameraModel { mount_pitch_deg: 10.0, ..none };
        assert!(close(tilted.camera_pose(&Pose::default()).pitch_deg, 10.0));
        assert!(!Pose::default().tilt_known() && !Pose { roll_deg: Some(0.0), ..Pose::default() }.tilt_known());
        assert!(pose(0.0, 0.0, 0.0).tilt_known());
    }

    proptest! {
        #[test]
        fn angles_come_back_from_the_rotation(yaw_deg in 0.0_f64..360.0, pitch_deg in -80.0_f64..80.0, roll_deg in -170.0_f64..170.0) {
            let back = Attitude::of_rotation(&Attitude { yaw_deg, pitch_deg, roll_deg }.rotation());
            prop_assert!(close(Some(back.yaw_deg), yaw_deg) && close(Some(back.pitch_deg), pitch_deg) && close(Some(back.roll_deg), roll_deg));
        }

        #[test]
        fn a_mount_and_its_opposite_cancel(yaw_deg in 0.0_f64..360.0, pitch_deg in -40.0_f64..40.0, roll_deg in -40.0_f64..40.0, turn_deg in -180.0_f64..180.0) {
            let there = CameraModel { mount_yaw_deg: turn_deg, ..CameraModel::default() };
            let back = CameraModel { mount_yaw_deg: -turn_deg, ..CameraModel::default() };
            let round = back.camera_pose(&there.camera_pose(&pose(yaw_deg, pitch_deg, roll_deg)));
            prop_assert!(close(round.yaw_deg, yaw_deg) && close(round.pitch_deg, pitch_deg) && close(round.roll_deg, roll_deg), "{round:?}");
        }
    }
}
