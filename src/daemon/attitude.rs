//! The vehicle's attitude at exposure, and the camera's pose that follows.

use crate::bus::AttitudeMessage;
use crate::thermal::{CameraModel, Pose};
use crate::track::Recent;

/// Messages kept: more than a second of the fastest usual stream.
const KEPT: usize = 512;

/// The last attitude messages.
#[derive(Debug)]
pub struct Attitudes {
    recent: Recent<AttitudeMessage>,
    max_age_s: f64,
}

impl Attitudes {
    /// None yet; further than `max_age_s` from the exposure a message says nothing.
    pub fn new(max_age_s: f64) -> Self {
        Self { recent: Recent::new(KEPT), max_age_s }
    }

    /// One more (checked when it was parsed).
    pub fn push(&mut self, message: AttitudeMessage) {
        self.recent.push(message.stamp_ns, message);
    }

    /// The vehicle's attitude and height at `stamp_ns`: between the message before and the one after, else the one of
    /// them that is near enough, else unknown.
    pub fn at(&self, stamp_ns: i64) -> Option<Pose> {
        let near = |found: Option<(i64, &AttitudeMessage)>| {
            found.filter(|(at, _)| at.abs_diff(stamp_ns) as f64 / 1e9 <= self.max_age_s).map(|(_, message)| message.clone())
        };
        let (before, after) = self.recent.around(stamp_ns);
        match (near(before), near(after)) {
            (Some(before), Some(after)) => Some(between(&before, &after, stamp_ns)),
            (Some(one), None) | (None, Some(one)) => Some(pose(&one)),
            (None, None) => None,
        }
    }
}

/// The camera's pose at exposure: what the frame states (it speaks of the camera), else what the vehicle's attitude
/// and the mount give (of a vehicle whose attitude is unknown: level), else the configured field of view, else unknown.
pub fn camera_pose(stated: &Pose, vehicle: Option<&Pose>, camera: &CameraModel) -> Pose {
    let derived = camera.camera_pose(&vehicle.copied().unwrap_or_default());
    Pose {
        agl_m: stated.agl_m.or(derived.agl_m),
        gsd_m: stated.gsd_m,
        hfov_deg: stated.hfov_deg.or(derived.hfov_deg),
        yaw_deg: stated.yaw_deg.or(derived.yaw_deg),
        pitch_deg: stated.pitch_deg.or(derived.pitch_deg),
        roll_deg: stated.roll_deg.or(derived.roll_deg),
    }
}

/// A message as a pose.
fn pose(message: &AttitudeMessage) -> Pose {
    Pose {
        agl_m: message.agl_m,
        yaw_deg: Some(message.yaw_deg.rem_euclid(360.0)),
        pitch_deg: Some(message.pitch_deg),
        roll_deg: Some(message.roll_deg),
        ..Pose::default()
    }
}

/// Linear between two messages, each angle the short way round.
fn between(before: &AttitudeMessage, after: &AttitudeMessage, stamp_ns: i64) -> Pose {
    let gap = before.stamp_ns.abs_diff(after.stamp_ns);
    let t = if gap == 0 { 0.0 } else { before.stamp_ns.abs_diff(stamp_ns) as f64 / gap as f64 };
    let angle = |from: f64, to: f64| from + t * wrap(to - from);
    Pose {
        agl_m: match (before.agl_m, after.agl_m) {
            (Some(from), Some(to)) => Some(from + t * (to - from)),
            (one, other) => one.or(other),
        },
        yaw_deg: Some(angle(before.yaw_deg, after.yaw_deg).rem_euclid(360.0)),
        pitch_deg: Some(wrap(angle(before.pitch_deg, after.pitch_deg))),
        roll_deg: Some(wrap(angle(before.roll_deg, after.roll_deg))),
        ..Pose::default()
    }
}

/// An angle in -180..180, degrees.
fn wrap(deg: f64) -> f64 {
    (deg + 180.0).rem_euclid(360.0) - 180.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const T0: i64 = 1_700_000_000_000 * MS;

    fn message(at_ms: i64, yaw_deg: f64, roll_deg: f64, agl_m: Option<f64>) -> AttitudeMessage {
        AttitudeMessage { stamp_ns: T0 + at_ms * MS, roll_deg, pitch_deg: 0.5 * roll_deg, yaw_deg, agl_m }
    }

    fn attitudes(messages: &[AttitudeMessage]) -> Attitudes {
        let mut attitudes = Attitudes::new(0.2);
        messages.iter().for_each(|m| attitudes.push(m.clone()));
        attitudes
    }

    fn close(found: Option<f64>, expected: f64) {
        let found = found.unwrap();
        assert!((found - expected).abs() < 1e-6, "{found} != {expected}");
    }

    #[test]
    fn interpolated_at_exposure_yaw_the_short_way() {
        let attitudes = attitudes(&[message(0, 350.0, 2.0, Some(400.0)), message(100, 10.0, 4.0, Some(410.0))]);
        let pose = attitudes.at(T0 + 25 * MS).unwrap();
        close(pose.yaw_deg, 355.0);
        close(pose.roll_deg, 2.5);
        close(pose.pitch_deg, 1.25);
        close(pose.agl_m, 402.5);
        close(attitudes.at(T0 + 75 * MS).unwrap().yaw_deg, 5.0);
        close(attitudes.at(T0).unwrap().yaw_deg, 350.0);
        let back = self::attitudes(&[message(0, 10.0, -179.0, None), message(100, -10.0, 179.0, None)]);
        close(back.at(T0 + 50 * MS).unwrap().yaw_deg, 0.0);
        close(back.at(T0 + 75 * MS).unwrap().roll_deg, 179.5);
    }

    #[test]
    fn older_than_the_limit_is_unknown() {
        let attitudes = attitudes(&[message(0, 90.0, 1.0, None)]);
        close(attitudes.at(T0 + 200 * MS).unwrap().yaw_deg, 90.0);
        assert_eq!(attitudes.at(T0 + 201 * MS), None);
        close(attitudes.at(T0 - 200 * MS).unwrap().yaw_deg, 90.0);
        assert_eq!(attitudes.at(T0 - 201 * MS), None);
        assert_eq!(Attitudes::new(0.2).at(T0), None);
    }

    #[test]
    fn out_of_order_and_repeated_stamps_are_no_trouble() {
        let attitudes = attitudes(&[message(100, 20.0, 0.0, None), message(0, 10.0, 0.0, None), message(100, 30.0, 0.0, None)]);
        close(attitudes.at(T0 + 50 * MS).unwrap().yaw_deg, 20.0);
        close(attitudes.at(T0 + 100 * MS).unwrap().yaw_deg, 30.0);
        for stamp_ns in [0, i64::MIN, i64::MAX] {
            assert_eq!(attitudes.at(stamp_ns), None);
        }
    }

    #[test]
    fn after_a_step_back_nothing_of_the_future_is_left() {
        // 20 Hz, 5 s of it; then the clock is 2 s back, and the vehicle looks the other way.
        let before: Vec<_> = (0..100).map(|i| message(50 * i, 90.0, 0.0, None)).collect();
        let mut attitudes = attitudes(&before);
        attitudes.push(message(2960, 270.0, 0.0, None));
        attitudes.push(message(3010, 270.0, 0.0, None));
        close(attitudes.at(T0 + 3000 * MS).unwrap().yaw_deg, 270.0);
        close(attitudes.at(T0 + 3050 * MS).unwrap().yaw_deg, 270.0);
    }

    #[test]
    fn one_side_too_old_leaves_the_other() {
        let attitudes = attitudes(&[message(0, 10.0, 0.0, None), message(500, 50.0, 0.0, None)]);
        close(attitudes.at(T0 + 150 * MS).unwrap().yaw_deg, 10.0);
        close(attitudes.at(T0 + 450 * MS).unwrap().yaw_deg, 50.0);
        assert_eq!(attitudes.at(T0 + 250 * MS), None);
    }

    #[test]
    fn what_the_frame_states_wins_and_unknown_stays_unknown() {
        let camera = CameraModel { hfov_deg: Some(32.0), ..CameraModel::default() };
        let vehicle =
            Pose { yaw_deg: Some(90.0), pitch_deg: Some(0.0), roll_deg: Some(0.0), agl_m: Some(400.0), ..Pose::default() };
        let stated = Pose { yaw_deg: Some(10.0), ..Pose::default() };
        let pose = camera_pose(&stated, Some(&vehicle), &camera);
        close(pose.yaw_deg, 10.0);
        close(pose.pitch_deg, 0.0);
        close(pose.agl_m, 400.0);
        close(pose.hfov_deg, 32.0);
        assert_eq!(pose.gsd_m, None);
        let pose = camera_pose(&Pose { hfov_deg: Some(20.0), ..Pose::default() }, None, &camera);
        assert_eq!(pose, Pose { hfov_deg: Some(20.0), ..Pose::default() });
    }

    #[test]
    fn a_tilted_mount_counts_without_an_attitude() {
        let camera = CameraModel { mount_pitch_deg: 10.0, mount_roll_deg: -4.0, ..CameraModel::default() };
        let pose = camera_pose(&Pose::default(), None, &camera);
        close(pose.pitch_deg, 10.0);
        close(pose.roll_deg, -4.0);
        assert_eq!(pose.yaw_deg, None);
        let stated = Pose { pitch_deg: Some(1.0), ..Pose::default() };
        let pose = camera_pose(&stated, None, &camera);
        close(pose.pitch_deg, 1.0);
        close(pose.roll_deg, -4.0);
    }
}
