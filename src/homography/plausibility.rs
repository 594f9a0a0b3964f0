//! Is this quad what a downward camera at that height could see?

use super::Quad;

/// What is expected, and how far off is still believed. From configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expected {
    /// Side of the frame's square, window pixels (metres).
    pub side_m: f64,
    /// Largest relative deviation of the scale (sqrt of the area ratio), e.g. 0.25.
    pub max_scale_error: f64,
    /// Largest rotation of the quad, degrees.
    pub max_rotation_deg: f64,
    /// Smallest ratio of opposite sides' lengths and of the diagonals (perspective, shear).
    pub min_side_ratio: f64,
}

/// Why it is not (reason `implausible_quad`).
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("quad: {what}: expected {expected}, found {found}")]
pub struct Implausible {
    /// Which property.
    pub what: &'static str,
    /// The bound.
    pub expected: String,
    /// The value.
    pub found: String,
}

/// Convex, same orientation, scale, rotation, sides.
pub fn check(quad: &Quad, expected: &Expected) -> Result<(), Implausible> {
    let _ = (quad, expected);
    todo!("homography")
}
