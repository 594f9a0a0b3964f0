//! Rectification: the camera's frame -> a north-up nadir square of ground.
//!
//! A pinhole over flat ground. In NED axes with the camera at the origin, the ground point of square pixel `(x, y)` is
//! `d = (N, E, h)`; in the camera's axes (FRD) it is `b = R^T d` with `R = Rz(yaw) Ry(pitch) Rx(roll)`; with the optical
//! axis down and image up = forward it falls on frame pixel `u = cx + f b_y / b_z`, `v = cy - f b_x / b_z`. Everything is
//! linear in `(x, y, 1)`, so square -> frame is one homography.

use super::pose::{Attitude, Pose, field, in_range};
use super::resample::{Source, warp};
use super::{FrameError, GrayFrame};
use nalgebra::{Matrix3, Vector3};

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

impl Rectified {
    /// Share of valid pixels, 0..=1.
    pub fn valid_fraction(&self) -> f64 {
        self.valid.iter().map(|&v| u64::from(v)).sum::<u64>() as f64 / self.valid.len().max(1) as f64
    }
}

/// Largest angle between the optical axis and the vertical, degrees.
const MAX_TILT_DEG: f64 = 45.0;
/// Largest side of the square, pixels.
const MAX_SIZE_PX: usize = 4096;

/// Rectifies a frame onto a square of `size_px` at `m_per_px` centred where the optical axis meets the ground.
/// The pose is the camera's. Unknown pitch and roll mean nadir; unknown yaw is an error (the caller decides what to
/// try); neither `gsd_m` nor `agl_m` with `hfov_deg` is an error.
///
/// `gsd_m` holds at nadir, i.e. it is height / focal length in pixels; where it is given it wins over height with field
/// of view. Away from nadir the focal length must be known as well: from `agl_m / gsd_m`, else from `hfov_deg`.
///
/// A frame that is finer than the square is averaged over whole blocks first, so that nothing aliases, then sampled
/// bilinearly; a coarser one is sampled bilinearly.
///
/// # Errors
/// [`FrameError::Field`] with the name of the missing or impossible value; tilts above 45 degrees are refused.
pub fn rectify(frame: &GrayFrame, pose: &Pose, size_px: usize, m_per_px: f64) -> Result<Rectified, FrameError> {
    let view = View::of(frame, pose, size_px, m_per_px)?;
    let source = Source::reduced(frame, view.frame_px_per_square_px)?;
    let (pixels, valid) = warp(&source, &view.frame_from_square, size_px);
    Ok(Rectified { size_px, m_per_px, pixels, valid, vehicle_px: view.vehicle_px, agl_m: view.agl_m })
}

/// How the square is seen by the frame.
#[derive(Debug, Clone)]
struct View {
    /// Square pixel -> frame pixel. Not scaled: the third coordinate is positive in front of the camera.
    frame_from_square: Matrix3<f64>,
    /// Frame pixels per square pixel in the middle of the square (geometric mean of both directions).
    frame_px_per_square_px: f64,
    vehicle_px: (f64, f64),
    agl_m: Option<f64>,
}

impl View {
    fn of(frame: &GrayFrame, pose: &Pose, size_px: usize, m_per_px: f64) -> Result<Self, FrameError> {
        if !(1..=MAX_SIZE_PX).contains(&size_px) {
            return Err(field("size_px", format!("1 to {MAX_SIZE_PX}"), size_px.to_string()));
        }
        in_range("m_per_px", m_per_px, 0.01, 100.0)?;
        pose.check()?;
        let Some(yaw_deg) = pose.yaw_deg else {
            return Err(field("yaw_deg", "degrees clockwise from true north".into(), "unknown".into()));
        };
        let attitude = Attitude { yaw_deg, pitch_deg: pose.pitch_deg.unwrap_or(0.0), roll_deg: pose.roll_deg.unwrap_or(0.0) };
        let tilt_deg = attitude.tilt_deg();
        let tilt_fits = tilt_deg <= MAX_TILT_DEG;
        if !tilt_fits {
            let found = format!("{tilt_deg:.1} degrees from pitch {} and roll {}", attitude.pitch_deg, attitude.roll_deg);
            return Err(field("pitch_deg, roll_deg", format!("a tilt within {MAX_TILT_DEG} degrees"), found));
        }
        let optics = Optics::of(frame.width, pose, tilt_deg == 0.0)?;
        Ok(Self::from_parts(frame, &attitude, &optics, size_px, m_per_px))
    }

    fn from_parts(frame: &GrayFrame, attitude: &Attitude, optics: &Optics, size_px: usize, m_per_px: f64) -> Self {
        let to_ned = attitude.rotation();
        let (height, focal) = (optics.height_m, optics.focal_px);
        // Where the optical axis meets the ground, north and east of the vehicle.
        let axis = to_ned.column(2) * (height / to_ned[(2, 2)]);
        let middle = (size_px as f64 - 1.0) / 2.0;
        let ned_from_square = Matrix3::new(
            0.0,
            -m_per_px,
            axis[0] + m_per_px * middle,
            m_per_px,
            0.0,
            axis[1] - m_per_px * middle,
            0.0,
            0.0,
            height,
        );
        let (cx, cy) = ((f64::from(frame.width) - 1.0) / 2.0, (f64::from(frame.height) - 1.0) / 2.0);
        let frame_from_body = Matrix3::new(0.0, focal, cx, -focal, 0.0, cy, 0.0, 0.0, 1.0);
        let frame_from_square = frame_from_body * to_ned.transpose() * ned_from_square;
        // Area ratio of a homography M at p: det(M) / w(p)^3.
        let w = (frame_from_square * Vector3::new(middle, middle, 1.0))[2];
        let frame_px_per_square_px = (frame_from_square.determinant() / w.powi(3)).abs().sqrt();
        let vehicle_px = (middle - axis[1] / m_per_px, middle + axis[0] / m_per_px);
        Self { frame_from_square, frame_px_per_square_px, vehicle_px, agl_m: optics.agl_m }
    }
}

/// Height and focal length; at nadir only their ratio counts.
#[derive(Debug, Clone, Copy)]
struct Optics {
    /// Height above ground, metres.
    height_m: f64,
    focal_px: f64,
    agl_m: Option<f64>,
}

impl Optics {
    fn of(width_px: u32, pose: &Pose, nadir: bool) -> Result<Self, FrameError> {
        let half_width = f64::from(width_px) / 2.0;
        let focal_of_hfov = pose.hfov_deg.map(|hfov_deg| half_width / (hfov_deg.to_radians() / 2.0).tan());
        let Some(gsd_m) = pose.gsd_m else {
            let (Some(height_m), Some(focal_px)) = (pose.agl_m, focal_of_hfov) else {
                let found = format!("agl_m {}, hfov_deg {}", known(pose.agl_m), known(pose.hfov_deg));
                return Err(field("gsd_m", "a number, or agl_m with hfov_deg".into(), found));
            };
            return Ok(Self { height_m, focal_px, agl_m: Some(height_m) });
        };
        let agl_m = pose.agl_m.or(focal_of_hfov.map(|focal_px| gsd_m * focal_px));
        if nadir {
            return Ok(Self { height_m: gsd_m, focal_px: 1.0, agl_m });
        }
        let Some(height_m) = agl_m else {
            return Err(field("hfov_deg", "hfov_deg or agl_m beside gsd_m, as pitch or roll is not 0".into(), "neither".into()));
        };
        let focal_px = height_m / gsd_m;
        in_range("agl_m / gsd_m, as horizontal field of view", 2.0 * (half_width / focal_px).atan().to_degrees(), 1.0, 150.0)?;
        Ok(Self { height_m, focal_px, agl_m })
    }
}

fn known(value: Option<f64>) -> String {
    value.map_or_else(|| "unknown".into(), |v| v.to_string())
}

#[cfg(test)]
#[path = "rectify_tests.rs"]
mod tests;
