//! Runs the Python oracles of the tests.
#![allow(dead_code, reason = "every test file takes what it needs")]

use std::path::{Path, PathBuf};
use std::process::Command;

/// The repository's root.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The interpreter with rasterio and pyproj: `.venv` of the checkout or of a folder above it.
pub fn python() -> PathBuf {
    let found = root().ancestors().map(|dir| dir.join(".venv/bin/python")).find(|p| p.exists());
    found.unwrap_or_else(|| panic!("no .venv/bin/python at or above {}: run `make venv` first", root().display()))
}

/// Runs `tests/oracle/SCRIPT OUT ARGS...`; the folder it wrote to.
pub fn run(script: &str, args: &[&str]) -> tempfile::TempDir {
    let out = tempfile::tempdir().unwrap();
    let status =
        Command::new(python()).arg(root().join("tests/oracle").join(script)).arg(out.path()).args(args).status().unwrap();
    assert!(status.success(), "{script} {args:?}: {status}");
    out
}

/// The folder of shared data beside the checkout, if there is one.
pub fn shared() -> Option<PathBuf> {
    root().ancestors().map(|dir| dir.join("shared")).find(|p| p.join("data").is_dir())
}
