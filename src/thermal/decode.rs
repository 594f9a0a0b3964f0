//! Frame bytes -> samples. Sizes are bounded before anything is allocated.

use super::pose::field;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits, Rgba};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::io::Cursor;
use std::path::Path;
use std::str::FromStr;

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

impl Encoding {
    /// By the file's ending: `.png`, `.tif`, `.tiff`, `.jpg`, `.jpeg`, and `.y16` or `.raw` for raw samples.
    pub fn of_file(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "png" => Some(Self::Png),
            "tif" | "tiff" => Some(Self::Tiff),
            "jpg" | "jpeg" => Some(Self::Jpeg),
            "y16" | "raw" => Some(Self::Y16le),
            _ => None,
        }
    }
}

impl FromStr for Encoding {
    type Err = FrameError;
    /// As in the messages: `png`, `tiff`, `jpeg`, `y16le`.
    fn from_str(name: &str) -> Result<Self, FrameError> {
        match name {
            "png" => Ok(Self::Png),
            "tiff" => Ok(Self::Tiff),
            "jpeg" => Ok(Self::Jpeg),
            "y16le" => Ok(Self::Y16le),
            _ => Err(field("encoding", "png, tiff, jpeg or y16le".into(), format!("{name:?}"))),
        }
    }
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

/// Largest width and height, pixels.
pub const MAX_SIDE_PX: u32 = 4096;
/// Bound on what a decoder may allocate: a 16-bit RGBA image of the largest size, and half as much again for its own use.
const MAX_DECODER_BYTES: u64 = MAX_SIDE_PX as u64 * MAX_SIDE_PX as u64 * 12;

/// Decodes a frame. `size_px` (width, height) is needed for [`Encoding::Y16le`] and checked elsewhere if given.
///
/// Colour images become luma by the ITU-R 601 weights of the published pipeline, in its integer form:
/// `(19595 R + 38470 G + 7471 B + 32768) >> 16`; alpha is dropped, palettes are expanded. At most 4096 x 4096 px; sizes are
/// checked before anything is allocated.
///
/// # Errors
/// [`FrameError::Decode`] for bytes that are not what the encoding says (or hold floating-point samples),
/// [`FrameError::Field`] for a size or a payload length that does not fit.
pub fn decode(bytes: &[u8], encoding: Encoding, size_px: Option<(u32, u32)>) -> Result<RawFrame, FrameError> {
    let format = match encoding {
        Encoding::Png => ImageFormat::Png,
        Encoding::Tiff => ImageFormat::Tiff,
        Encoding::Jpeg => ImageFormat::Jpeg,
        Encoding::Y16le => return decode_y16le(bytes, size_px),
    };
    let failed = |error: image::ImageError| FrameError::Decode { encoding, why: error.to_string() };
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    limits.max_alloc = Some(MAX_DECODER_BYTES);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(failed)?;
    let (width, height) = decoder.dimensions();
    check_size(width, height)?;
    if let Some((stated_width, stated_height)) = size_px {
        same("width", stated_width, width)?;
        same("height", stated_height, height)?;
    }
    let samples = match DynamicImage::from_decoder(decoder).map_err(failed)? {
        DynamicImage::ImageLuma8(image) => Samples::U8(image.into_raw()),
        DynamicImage::ImageLuma16(image) => Samples::U16(image.into_raw()),
        DynamicImage::ImageLumaA8(image) => Samples::U8(image.pixels().map(|p| p.0[0]).collect()),
        DynamicImage::ImageLumaA16(image) => Samples::U16(image.pixels().map(|p| p.0[0]).collect()),
        DynamicImage::ImageRgb8(image) => Samples::U8(image.pixels().map(|p| luma8(p.0)).collect()),
        DynamicImage::ImageRgba8(image) => Samples::U8(image.pixels().map(|&Rgba([r, g, b, _])| luma8([r, g, b])).collect()),
        DynamicImage::ImageRgb16(image) => Samples::U16(image.pixels().map(|p| luma16(p.0)).collect()),
        DynamicImage::ImageRgba16(image) => Samples::U16(image.pixels().map(|&Rgba([r, g, b, _])| luma16([r, g, b])).collect()),
        other => {
            let why = format!("samples of 8 or 16 bit are expected, found {:?}", other.color());
            return Err(FrameError::Decode { encoding, why });
        }
    };
    Ok(RawFrame { width, height, samples })
}

fn decode_y16le(bytes: &[u8], size_px: Option<(u32, u32)>) -> Result<RawFrame, FrameError> {
    let Some((width, height)) = size_px else {
        return Err(field("width", "a number, with encoding y16le".into(), "none".into()));
    };
    check_size(width, height)?;
    let expected = u64::from(width) * u64::from(height) * 2;
    if bytes.len() as u64 != expected {
        return Err(field("payload", format!("{expected} bytes ({width} x {height} x 2)"), format!("{} bytes", bytes.len())));
    }
    let samples = bytes.as_chunks::<2>().0.iter().map(|&pair| u16::from_le_bytes(pair)).collect();
    Ok(RawFrame { width, height, samples: Samples::U16(samples) })
}

fn check_size(width: u32, height: u32) -> Result<(), FrameError> {
    for (name, found) in [("width", width), ("height", height)] {
        if !(1..=MAX_SIDE_PX).contains(&found) {
            return Err(field(name, format!("1 to {MAX_SIDE_PX} px"), format!("{found} px")));
        }
    }
    Ok(())
}

fn same(name: &'static str, stated: u32, found: u32) -> Result<(), FrameError> {
    if stated == found { Ok(()) } else { Err(field(name, format!("{stated} px, as stated"), format!("{found} px in the image"))) }
}

fn weighted(rgb: [u32; 3]) -> u32 {
    // The weights sum to 65536, so that grey stays what it is; 16-bit samples just fit.
    (19595 * rgb[0] + 38470 * rgb[1] + 7471 * rgb[2] + 0x8000) >> 16
}

fn luma8(rgb: [u8; 3]) -> u8 {
    weighted(rgb.map(u32::from)) as u8
}

fn luma16(rgb: [u16; 3]) -> u16 {
    weighted(rgb.map(u32::from)) as u16
}

#[cfg(test)]
#[path = "decode_tests.rs"]
mod tests;
