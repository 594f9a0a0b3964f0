//! A bundle, opened: manifest checked, digests checked, sessions made, golden pair run.

use super::{Graph, Manifest, Runtime};
use std::path::Path;

/// What can be wrong with a bundle: refused at start, with the field named.
#[derive(Debug, thiserror::Error)]
pub enum BundleError {
    /// A file is missing or unreadable.
    #[error("bundle `{bundle}`: {file}: {why}")]
    File {
        /// Folder.
        bundle: String,
        /// File in it.
        file: String,
        /// The cause.
        why: String,
    },
    /// A field is missing, unknown or not what it must be.
    #[error("bundle `{bundle}`: {field}: expected {expected}, found {found}")]
    Field {
        /// Folder.
        bundle: String,
        /// Manifest field, graph input or golden array.
        field: String,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
}

/// An opened bundle.
pub struct Bundle {
    /// Its manifest.
    pub manifest: Manifest,
    /// Coarse map encoder.
    pub coarse_map: Graph,
    /// Coarse matcher or frame encoder.
    pub coarse: Graph,
    /// Refine map encoder and matcher.
    pub refine: Option<(Graph, Graph)>,
}

impl Bundle {
    /// Opens a bundle and checks all of it: manifest, digests, graph inputs and outputs, golden pair.
    pub fn open(folder: &Path, runtime: &Runtime) -> Result<Self, BundleError> {
        let _ = (folder, runtime);
        todo!("model")
    }
}
