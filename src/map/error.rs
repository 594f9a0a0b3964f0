//! What can be wrong with a map.

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
}
