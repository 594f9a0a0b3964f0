//! Reading a bundle's files: regular files only, bounded, digest checked against the bytes that are then used.

use super::{BundleError, FileRef};
use sha2::{Digest, Sha256};
use std::io::Read;
use std::path::Path;

/// Largest graph, bytes.
pub const MAX_GRAPH_BYTES: u64 = 512 << 20;
/// Largest manifest, bytes.
pub const MAX_MANIFEST_BYTES: u64 = 1 << 20;

/// Reads a regular file of at most `limit` bytes. A pipe or device, which might never end, is refused unopened.
pub fn read_bounded(folder: &Path, file: &str, limit: u64) -> Result<Vec<u8>, BundleError> {
    let failed = |why: String| BundleError::File { bundle: folder.display().to_string(), file: file.into(), why };
    let path = folder.join(file);
    let metadata = std::fs::metadata(&path).map_err(|e| failed(e.to_string()))?;
    if !metadata.is_file() {
        return Err(failed("expected a regular file, found something else".into()));
    }
    if metadata.len() > limit {
        return Err(failed(format!("expected at most {limit} bytes, found {}", metadata.len())));
    }
    let mut bytes = Vec::with_capacity(metadata.len() as usize);
    let opened = std::fs::File::open(&path).map_err(|e| failed(e.to_string()))?;
    // It may have grown since.
    opened.take(limit + 1).read_to_end(&mut bytes).map_err(|e| failed(e.to_string()))?;
    if bytes.len() as u64 > limit {
        return Err(failed(format!("expected at most {limit} bytes, found more")));
    }
    Ok(bytes)
}

/// Reads a file that the manifest names, and checks its digest.
pub fn read_checked(folder: &Path, field: &str, file: &FileRef, limit: u64) -> Result<Vec<u8>, BundleError> {
    let bytes = read_bounded(folder, &file.file, limit)?;
    let found: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
    if found != file.sha256 {
        return Err(BundleError::Field {
            bundle: folder.display().to_string(),
            field: format!("{field}.sha256 (of `{}`)", file.file),
            expected: file.sha256.clone(),
            found,
        });
    }
    Ok(bytes)
}
