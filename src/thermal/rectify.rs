//! Rectification: the camera's frame -> a north-up nadir square of ground.

use super::{FrameError, GrayFrame};
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

/// A north-up square of ground, `size_px` at `m_per_px`, as the sensor saw it.
#[derive(Debug, Clone, PartialEq)]
pub struct Rectified {
    /// Side, pixels.
    pub size_px: usize,
    /// Ground metres per pixel.
    pub m_per_px: f64,
    /// Row-major 8-bit values; 0 where the sensor saw nothing.
    pub pixels: Vec<u8>,
    /// 1 where the sensor saw the ground, else 0.
    pub valid: Vec<u8>,
    /// The point under the vehicle, in pixels of this square (may lie outside it).
    pub vehicle_px: (f64, f64),
    /// Height above ground that was used, metres, where known.
    pub agl_m: Option<f64>,
}

impl CameraModel {
    /// Vehicle attitude in `pose` -> camera attitude, by the mount's rotation.
    pub fn camera_pose(&self, pose: &Pose) -> Pose {
        let _ = pose;
        todo!("thermal")
    }
}

/// Rectifies a frame onto a square of `size_px` at `m_per_px` centred where the optical axis meets the ground.
/// The pose is the camera's. Unknown pitch and roll mean nadir; unknown yaw is an error (the caller decides what to
/// try); neither `gsd_m` nor `agl_m` with `hfov_deg` is an error.
pub fn rectify(frame: &GrayFrame, pose: &Pose, size_px: usize, m_per_px: f64) -> Result<Rectified, FrameError> {
    let _ = (frame, pose, size_px, m_per_px);
    todo!("thermal")
}
