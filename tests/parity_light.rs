//! The light stages in Rust against Python's (`sthn.correlate`) for the same pixels: hypotheses, correlation, posterior,
//! sub-cell peak, oriented crop.
//!
//! `models/tests/rust_parity_light.py` says what Python finds. Needs PyTorch (`make py`), so that it is ignored by default;
//! `make parity` runs it.

use nightfix::locate::pair::{Search, Steps, encode_map, match_pair};
use nightfix::locate::{FrameView, WindowView};
use nightfix::model::{Bundle, Provider, Runtime};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

/// Corners, metres in the window: a thousandth of a coarse cell.
const CORNER_TOLERANCE_M: f64 = 0.01;
/// Evidence, relative.
const EVIDENCE_TOLERANCE: f64 = 1e-3;

#[derive(Deserialize)]
struct Case {
    name: String,
    disc: Option<[f64; 3]>,
    coarse: [[f64; 2]; 4],
    quad: Option<[[f64; 2]; 4]>,
    evidence: BTreeMap<String, f64>,
}

fn largest(a: &[[f64; 2]; 4], b: &[[f64; 2]; 4]) -> f64 {
    let far = |d: f64| if d.is_nan() { f64::INFINITY } else { d.abs() };
    a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| far(a - b)).fold(0.0, f64::max)
}

#[test]
#[ignore = "needs PyTorch: make parity"]
fn rust_and_python_agree_on_the_light_stages() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = tempfile::tempdir().unwrap();
    let bundle_folder = root.join("models/bundles/lite-1536");
    let output = Command::new(root.join(".venv/bin/python"))
        .arg(root.join("models/tests/rust_parity_light.py"))
        .arg(&bundle_folder)
        .arg(folder.path())
        .env("PYTHONPATH", root.join("models"))
        .output()
        .expect(".venv/bin/python (make py)");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cases: Vec<Case> = serde_json::from_slice(&output.stdout).expect("JSON of rust_parity_light.py");

    let runtime =
        Runtime::open(None, None, Provider::Cpu, 1).expect("`make build` puts ONNX Runtime beside the test executables");
    let mut bundle = Bundle::open(&bundle_folder, &runtime).unwrap();
    let window = image::open(folder.path().join("window.png")).unwrap().to_rgb8();
    let view = WindowView { size_px: window.width() as usize, rgb: window.as_raw() };
    let mut map = encode_map(&mut bundle, &view).unwrap();
    for case in &cases {
        let gray = |name: String| image::open(folder.path().join(name)).unwrap().to_luma8().into_raw();
        let (frame, seen) = (gray(format!("{}.png", case.name)), gray(format!("{}_mask.png", case.name)));
        let frame_view = FrameView { size_px: bundle.manifest.frame_px(), gray: &frame, seen: &seen };
        let whole = Search::whole(&bundle.manifest);
        let search = case.disc.map_or(whole, |[x, y, radius_m]| Search { centre_px: [x, y], radius_m, ..whole });
        let found = match_pair(&mut bundle, &view, &mut map, &frame_view, &search, &mut Steps::start()).unwrap();
        let coarse = largest(&found.coarse.0, &case.coarse);
        let last = largest(&found.quad.0, case.quad.as_ref().unwrap_or(&case.coarse));
        println!("{}: coarse {coarse:.2e} m, last {last:.2e} m", case.name);
        assert!(coarse <= CORNER_TOLERANCE_M && last <= CORNER_TOLERANCE_M, "{}: coarse {coarse} m, last {last} m", case.name);
        for (name, expected) in &case.evidence {
            let value = found.evidence[name];
            let fine = (value - expected).abs() <= EVIDENCE_TOLERANCE * expected.abs().max(1e-3);
            assert!(fine, "{}: {name}: {value}, in Python {expected}", case.name);
        }
    }
}
