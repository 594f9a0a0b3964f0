//! Quads, corner displacements, DLT, plausibility. Pixel coordinates: x right, y down, an integer is a centre.

mod dlt;
mod plausibility;
mod quad;

pub use dlt::{DltError, Homography, dlt};
pub use plausibility::{Expected, Implausible, check};
pub use quad::{Displacement, Quad, box_of_inclusive, displacement_of_box};
