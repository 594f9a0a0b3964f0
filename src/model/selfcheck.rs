//! The golden pair, run on the execution provider really in use.
//!
//! Each graph gets its stored inputs, so that errors do not add up; then the whole pipeline gets map and frame. A bundle
//! whose numbers this machine does not reproduce is refused.

use super::bundle::{Bundle, BundleError, GoldenDifference};
use super::golden::{GRAPHS, Golden};
use super::{StageManifest, Tensor};
use crate::homography::{Homography, Quad};
use crate::locate::pair::{PairError, Search, Steps, encode_map, match_pair};
use crate::locate::{FrameView, WindowView};

/// Allowed difference of the whole pipeline, pixels of the coarse stage's map input: inputs resampled here differ from
/// Python's in the last bits, and six iterations make more of it.
pub const PIPELINE_TOLERANCE_PX: f64 = 0.05;

/// Runs all of it; an error names the first array that differs.
pub fn run(bundle: &mut Bundle, golden: &Golden, name: &str) -> Result<Vec<GoldenDifference>, BundleError> {
    let mut report = Vec::new();
    let mut judge = |array: String, difference: f64, tolerance: f64| {
        // A difference that is not a number is none that is small enough.
        let fine = difference <= tolerance;
        if fine {
            report.push(GoldenDifference { array, difference, tolerance });
            return Ok(());
        }
        let (expected, found) = (format!("a difference of at most {tolerance:.3e}"), format!("{difference:.3e}"));
        Err(BundleError::Field { bundle: name.into(), field: format!("golden.npz: {array}"), expected, found })
    };
    let stages = bundle.manifest.refine.is_some();
    for graph_name in GRAPHS.into_iter().take(if stages { 4 } else { 2 }) {
        let tolerance = match (graph_name.starts_with("coarse"), &bundle.manifest.refine) {
            (false, Some(stage)) => stage.tolerance(),
            _ => bundle.manifest.coarse.tolerance(),
        };
        for (array, difference, tolerance) in graph_differences(bundle, golden, graph_name, tolerance, name)? {
            judge(array, difference, tolerance)?;
        }
    }
    let found = pipeline(bundle, golden).map_err(|e| BundleError::Field {
        bundle: name.into(),
        field: "golden.npz: map_rgb and frame".into(),
        expected: "a match".into(),
        found: e.to_string(),
    })?;
    let corners = found.final_displacement.iter().flatten().flatten().zip(golden.final_displacement.iter().flatten().flatten());
    judge("final".into(), largest(corners.map(|(a, b)| a - b)), PIPELINE_TOLERANCE_PX)?;
    let expected = Homography(golden.homography);
    let corners = Quad::edges(golden.frame_px).0.map(|[x, y]| (found.homography.apply(x, y), expected.apply(x, y)));
    let differences = corners.iter().flat_map(|(a, b)| [a[0] - b[0], a[1] - b[1]]);
    judge("homography".into(), largest(differences), PIPELINE_TOLERANCE_PX * bundle.manifest.coarse.map().m_per_px())?;
    Ok(report)
}

/// The largest magnitude; NaN if any is.
fn largest(differences: impl Iterator<Item = f64>) -> f64 {
    differences.fold(0.0, |most, d| if d.is_nan() || most.is_nan() { f64::NAN } else { most.max(d.abs()) })
}

/// Name, difference and bound of each stored output of one graph. Displacements are bounded by the stage's tolerance as it
/// stands; other outputs by tolerance times their largest magnitude, where that is above 1.
fn graph_differences(
    bundle: &mut Bundle,
    golden: &Golden,
    graph: &'static str,
    tolerance: f64,
    name: &str,
) -> Result<Vec<(String, f64, f64)>, BundleError> {
    let missing = |field: String, expected: &str, found: String| BundleError::Field {
        bundle: name.into(),
        field: format!("golden.npz: {field}"),
        expected: expected.into(),
        found,
    };
    let is_map = graph.ends_with("_map");
    let stage = if graph.starts_with("coarse") { Some(&bundle.manifest.coarse) } else { bundle.manifest.refine.as_ref() };
    let correlation = matches!(stage, Some(StageManifest::Correlation(_)));
    let (ports, main): (&[&str], &str) = match (is_map, correlation) {
        (true, _) => (&["map"], "map_features"),
        (false, true) => (&["frame"], "frame_features"),
        (false, false) => (&["map_features", "frame"], "displacement"),
    };
    let mut inputs: Vec<(&str, &Tensor)> = Vec::new();
    for port in ports {
        let key = format!("{graph}.in.{port}");
        let stored = golden.arrays.get(&key).or_else(|| golden.arrays.get(&format!("{graph}_map.out.{port}")));
        inputs.push((port, stored.ok_or_else(|| missing(key, "an array", "none".into()))?));
    }
    let outputs = match bundle.graph_mut(graph) {
        Some(runner) => runner.run(&inputs),
        None => return Ok(Vec::new()),
    };
    let outputs = outputs.map_err(|source| BundleError::Graph { bundle: name.into(), source })?;
    let prefix = format!("{graph}.out.");
    if !golden.arrays.contains_key(&format!("{prefix}{main}")) {
        return Err(missing(format!("{prefix}{main}"), "an array", "none".into()));
    }
    let mut differences = Vec::new();
    for (key, expected) in golden.arrays.iter().filter(|(key, _)| key.starts_with(&prefix)) {
        let port = key.strip_prefix(&prefix).unwrap_or_default();
        let found =
            outputs.get(port).ok_or_else(|| missing(key.clone(), "an output of the graph", "none of that name".into()))?;
        if found.shape != expected.shape {
            return Err(missing(key.clone(), &format!("the graph's shape {:?}", found.shape), format!("{:?}", expected.shape)));
        }
        let difference = largest(found.data.iter().zip(&expected.data).map(|(a, b)| f64::from(a - b)));
        let magnitude = if port == "displacement" { 1.0 } else { largest(expected.data.iter().map(|v| f64::from(*v))).max(1.0) };
        differences.push((key.clone(), difference, tolerance * magnitude));
    }
    Ok(differences)
}

/// From pixels to homography, as a query does it: D_C about the window's middle, nadir, yaw known, all of the frame seen.
fn pipeline(bundle: &mut Bundle, golden: &Golden) -> Result<crate::locate::pair::PairMatch, PairError> {
    let window = WindowView { size_px: golden.map_px, rgb: &golden.map_rgb };
    let seen = vec![1; golden.frame.len()];
    let frame = FrameView { size_px: golden.frame_px, gray: &golden.frame, seen: &seen };
    let mut map = encode_map(bundle, &window)?;
    let search = Search::whole(&bundle.manifest);
    match_pair(bundle, &window, &mut map, &frame, &search, &mut Steps::start())
}
