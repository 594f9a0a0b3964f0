//! The thermal frame: decoding (untrusted input), 16-to-8-bit tone mapping, rectification to north-up nadir.

mod decode;
mod rectify;
mod tone;

pub use decode::{Encoding, FrameError, RawFrame, Samples, decode};
pub use rectify::{CameraModel, Pose, Rectified, rectify};
pub use tone::{GrayFrame, TONE_MAPPING, tone_map};
