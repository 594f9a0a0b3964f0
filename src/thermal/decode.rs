//! Frame bytes -> samples. Sizes are bounded before anything is allocated.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How a frame's bytes are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Encoding {
    /// PNG, 8 or 16 bit.
    Png,
    /// TIFF, 8 or 16 bit.
    Tiff,
    /// JPEG, 8 bit.
    Jpeg,
    /// Raw samples, 16 bit little-endian, row-major; width and height come from outside.
    Y16le,
}

/// A frame's samples as the sensor gave them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Samples {
    /// Already display values: not tone-mapped again.
    U8(Vec<u8>),
    /// Radiometric or raw counts (often 14 bit in 16).
    U16(Vec<u16>),
}

/// A decoded frame, row-major, one channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawFrame {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// `width * height` samples.
    pub samples: Samples,
}

/// What can be wrong with a frame (reason `bad_frame`).
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// The bytes are not what the encoding says.
    #[error("frame: {encoding:?} cannot be decoded: {why}")]
    Decode {
        /// The encoding.
        encoding: Encoding,
        /// The decoder's words.
        why: String,
    },
    /// A field is missing or out of range.
    #[error("frame: {field}: expected {expected}, found {found}")]
    Field {
        /// Which.
        field: &'static str,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// The file could not be read.
    #[error("frame `{file}`: {why}")]
    Unreadable {
        /// The file as the flight names it.
        file: String,
        /// The cause.
        why: String,
    },
}

/// Decodes a frame. `size_px` (width, height) is needed for [`Encoding::Y16le`] and checked elsewhere if given.
/// Colour images become luma. At most 4096 x 4096 px.
pub fn decode(bytes: &[u8], encoding: Encoding, size_px: Option<(u32, u32)>) -> Result<RawFrame, FrameError> {
    let _ = (bytes, encoding, size_px);
    todo!("thermal")
}
