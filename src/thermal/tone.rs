//! The 16-to-8-bit tone mapping, versioned; the same in Python (`sthn.tone`).

use super::RawFrame;

/// The version implemented here; a bundle states the one it was trained with.
pub const TONE_MAPPING: u32 = 1;

/// An 8-bit frame, row-major.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrayFrame {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// `width * height` values.
    pub pixels: Vec<u8>,
}

/// Maps a frame to 8 bits; 8-bit frames pass unchanged.
pub fn tone_map(frame: &RawFrame) -> GrayFrame {
    let _ = frame;
    todo!("thermal")
}
