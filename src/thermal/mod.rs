//! The thermal frame: decoding (untrusted input), 16-to-8-bit tone mapping, rectification to north-up nadir.

mod decode;
mod pose;
mod rectify;
mod resample;
mod tone;

pub use decode::{Encoding, FrameError, MAX_SIDE_PX, RawFrame, Samples, decode};
pub use pose::{CameraModel, Pose};
pub use rectify::{Rectified, rectify};
pub use tone::{GrayFrame, TONE_MAPPING, tone_map};
