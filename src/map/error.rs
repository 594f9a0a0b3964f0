//! What can be wrong with a map.

use crate::geo::GeoError;
use std::path::PathBuf;

/// What can be wrong with a map. Every text names the file, the field, the expected and the found value.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The file could not be opened or read.
    #[error("map `{path}`: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is not a GeoTIFF that nightfix reads.
    #[error("map `{path}`: {field}: expected {expected}, found {found}")]
    Format {
        /// The file.
        path: PathBuf,
        /// Tag or property.
        field: &'static str,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A tile or strip could not be decoded.
    #[error("map `{path}`: overview {level}, chunk {chunk}: expected pixels, found {found}")]
    Decode {
        /// The file.
        path: PathBuf,
        /// 0 for the full image, 1 for its first overview.
        level: usize,
        /// Number of the tile or strip.
        chunk: u32,
        /// What the decoder said.
        found: String,
    },
    /// The map's place on Earth cannot be worked out.
    #[error("map `{path}`: centre: {source}")]
    Place {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: GeoError,
    },
    /// A window that cannot be made from any map.
    #[error("window of {width_m} m at {m_per_px} m/px: {field}: expected {expected}")]
    Window {
        /// Side asked for, metres.
        width_m: f64,
        /// Metres per pixel asked for.
        m_per_px: f64,
        /// What is wrong.
        field: &'static str,
        /// What it must be.
        expected: &'static str,
    },
}
