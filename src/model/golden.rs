//! `golden.npz`: one input pair and every output. Read with bounds: no size that the file states is believed before it
//! is checked, and nothing is allocated beyond the bounds.
//!
//! Layout: `map_rgb` u8 `[W, W, 3]` with W = `window_width_m + 2 window_margin_m` at 1 m/px, `frame` u8 `[F, F]`, then
//! `<graph>.in.<name>` and `<graph>.out.<name>` f32, where `<graph>` is `coarse_map`, `coarse`, `refine_map` or `refine`;
//! `final` f64 `[2, 2, 2]` and `homography` f64 `[3, 3]`. `coarse.in.map_features` and `refine.in.map_features` may be
//! left out: they are the map encoder's output.

use super::{BundleError, Tensor, npy};
use crate::homography::Displacement;
use std::collections::BTreeMap;
use std::io::{Cursor, Read};

/// Largest `golden.npz`, bytes: the contract's 10 MiB.
pub const MAX_GOLDEN_BYTES: u64 = 10 << 20;
/// Most bytes of all its arrays together.
const MAX_TOTAL_BYTES: u64 = 256 << 20;
/// Most arrays.
const MAX_ARRAYS: usize = 64;

/// The names of the four graphs, as the golden pair's keys and errors use them.
pub const GRAPHS: [&str; 4] = ["coarse_map", "coarse", "refine_map", "refine"];

/// The golden pair.
#[derive(Debug, Clone)]
pub struct Golden {
    /// Side of the map square, pixels.
    pub map_px: usize,
    /// Its RGB, interleaved.
    pub map_rgb: Vec<u8>,
    /// Side of the frame, pixels.
    pub frame_px: usize,
    /// Its gray values.
    pub frame: Vec<u8>,
    /// Arrays of the graphs by key, e.g. `coarse.in.frame`.
    pub arrays: BTreeMap<String, Tensor>,
    /// Final displacement, in pixels of the coarse stage's map input.
    pub final_displacement: Displacement,
    /// Rectified-frame px -> window px.
    pub homography: [[f64; 3]; 3],
}

impl Golden {
    /// Reads a golden pair. `map_px` and `frame_px` are what the manifest leads to.
    pub fn read(bytes: &[u8], bundle: &str, map_px: usize, frame_px: usize) -> Result<Self, BundleError> {
        let wrong = |field: &str, expected: String, found: String| BundleError::Field {
            bundle: bundle.into(),
            field: format!("golden.npz: {field}"),
            expected,
            found,
        };
        let mut entries = read_entries(bytes, bundle)?;
        let mut take = |name: &str, shape: &[usize]| -> Result<npy::Array, BundleError> {
            let array = entries.remove(name).ok_or_else(|| wrong(name, format!("an array {shape:?}"), "none".into()))?;
            if array.shape == shape { Ok(array) } else { Err(wrong(name, format!("{shape:?}"), format!("{:?}", array.shape))) }
        };
        let map_rgb = take("map_rgb", &[map_px, map_px, 3])?;
        let frame = take("frame", &[frame_px, frame_px])?;
        let corners = take("final", &[2, 2, 2])?;
        let matrix = take("homography", &[3, 3])?;
        let dtype = |field: &str, expected: &str, array: &npy::Array| wrong(field, expected.into(), array.values.dtype().into());
        let mut final_displacement = Displacement::default();
        let values = corners.values.as_f64().ok_or_else(|| dtype("final", "f64", &corners))?;
        for (to, from) in final_displacement.iter_mut().flatten().flatten().zip(values) {
            *to = *from;
        }
        let mut homography = [[0.0; 3]; 3];
        let values = matrix.values.as_f64().ok_or_else(|| dtype("homography", "f64", &matrix))?;
        for (to, from) in homography.iter_mut().flatten().zip(values) {
            *to = *from;
        }
        let map_rgb = map_rgb.values.into_u8().ok_or_else(|| wrong("map_rgb", "u8".into(), "another type".into()))?;
        let frame = frame.values.into_u8().ok_or_else(|| wrong("frame", "u8".into(), "another type".into()))?;
        let mut arrays = BTreeMap::new();
        for (name, array) in entries {
            let known = GRAPHS.iter().any(|graph| {
                let rest = name.strip_prefix(graph).unwrap_or("");
                rest.starts_with(".in.") || rest.starts_with(".out.")
            });
            if !known {
                return Err(wrong(&name, "`<graph>.in.<name>` or `<graph>.out.<name>`".into(), "an unknown array".into()));
            }
            let found = array.values.dtype();
            let data = array.values.into_f32().ok_or_else(|| wrong(&name, "f32".into(), found.into()))?;
            arrays.insert(name, Tensor { shape: array.shape, data });
        }
        Ok(Self { map_px, map_rgb, frame_px, frame, arrays, final_displacement, homography })
    }
}

/// Every array of the archive, within the bounds.
fn read_entries(bytes: &[u8], bundle: &str) -> Result<BTreeMap<String, npy::Array>, BundleError> {
    let failed = |why: String| BundleError::File { bundle: bundle.into(), file: "golden.npz".into(), why };
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes)).map_err(|e| failed(e.to_string()))?;
    if archive.len() > MAX_ARRAYS {
        return Err(failed(format!("expected at most {MAX_ARRAYS} arrays, found {}", archive.len())));
    }
    let mut left = MAX_TOTAL_BYTES;
    let mut entries = BTreeMap::new();
    for index in 0..archive.len() {
        let entry = archive.by_index(index).map_err(|e| failed(e.to_string()))?;
        let name = entry.name().strip_suffix(".npy").map(str::to_owned);
        let name = name.ok_or_else(|| failed(format!("expected only .npy files, found `{}`", entry.name().escape_debug())))?;
        if entry.size() > left {
            return Err(failed(format!("`{name}`: expected at most {left} bytes more, found {}", entry.size())));
        }
        // The stated size may be a lie: read no more than is left.
        let array = npy::read(entry.take(left), left).map_err(|why| failed(format!("`{}`: {why}", name.escape_debug())))?;
        left = left.saturating_sub(array.values.bytes());
        if entries.insert(name.clone(), array).is_some() {
            return Err(failed(format!("`{}` stands twice", name.escape_debug())));
        }
    }
    Ok(entries)
}
