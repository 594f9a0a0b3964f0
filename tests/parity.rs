//! The Rust pipeline against the Python one, for the same pair: from decoded pixels to latitude and longitude.
//!
//! `models/tests/rust_parity.py` makes bundle, map and frame and says what Python finds. Needs PyTorch (`make py`), so that it
//! is ignored by default; `make parity` runs it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

use nightfix::config::{BudgetSettings, GateSettings};
use nightfix::geo::LatLon;
use nightfix::homography::{Homography, Quad};
use nightfix::locate::pair::{Search, Steps, encode_map, match_pair};
use nightfix::locate::{EncodedFrame, FrameView, Localizer, Prior, PriorSource, Query, WindowView};
use nightfix::map::{GeoTiff, MapCache};
use nightfix::model::{Bundle, Provider, Runtime};
use nightfix::thermal::{Encoding, Pose};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Corners: pixels of the coarse input (W_R).
const CORNER_TOLERANCE_PX: f64 = 0.005;
/// Position, metres.
const POSITION_TOLERANCE_M: f64 = 0.05;

/// What Python found. Quads are TL, TR, BL, BR, edges of the frame in window px.
#[derive(Deserialize)]
struct Expected {
    onnxruntime: PathBuf,
    bundle: String,
    m_per_px: f64,
    centre: [f64; 2],
    coarse: [[f64; 2]; 4],
    quad: [[f64; 2]; 4],
    #[serde(rename = "final")]
    final_displacement: [[[f64; 2]; 2]; 2],
    homography: [[f64; 3]; 3],
    position: [f64; 2],
    map_crs: [f64; 2],
}

fn python(folder: &Path) -> Expected {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(root.join(".venv/bin/python"))
        .arg(root.join("models/tests/rust_parity.py"))
        .arg(folder)
        .env("PYTHONPATH", root.join("models"))
        .output()
        .expect(".venv/bin/python (make py)");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON of rust_parity.py")
}

/// NaN counts as infinitely far.
fn largest(a: impl IntoIterator<Item = f64>, b: impl IntoIterator<Item = f64>) -> f64 {
    let far = |d: f64| if d.is_nan() { f64::INFINITY } else { d };
    a.into_iter().zip(b).map(|(a, b)| far((a - b).abs())).fold(0.0, f64::max)
}

fn apart(a: &[[f64; 2]; 4], b: &[[f64; 2]; 4]) -> f64 {
    largest(a.iter().flatten().copied(), b.iter().flatten().copied())
}

fn corners(homography: [[f64; 3]; 3]) -> [[f64; 2]; 4] {
    Quad::edges(512).0.map(|[x, y]| Homography(homography).apply(x, y))
}

#[test]
#[ignore = "needs PyTorch: make parity"]
fn rust_and_python_agree_from_pixels_to_position() {
    let folder = tempfile::tempdir().unwrap();
    let expected = python(folder.path());
    let runtime = Runtime::load(&expected.onnxruntime, Provider::Cpu, 2).unwrap();
    let mut bundle = Bundle::open(&folder.path().join(&expected.bundle), &runtime).unwrap();
    same_pixels(folder.path(), &expected, &mut bundle);
    whole_way(folder.path(), &expected, bundle);
}

/// Resize, coarse, crop, refine, DLT, from the very pixels that Python had.
fn same_pixels(folder: &Path, expected: &Expected, bundle: &mut Bundle) {
    let window = image::open(folder.join("window.png")).unwrap().to_rgb8();
    let frame = image::open(folder.join("frame.png")).unwrap().to_luma8();
    let view = WindowView { size_px: window.width() as usize, rgb: window.as_raw() };
    let seen = vec![1; frame.as_raw().len()];
    let frame_view = FrameView { size_px: frame.width() as usize, gray: frame.as_raw(), seen: &seen };
    let search = Search::whole(&bundle.manifest);
    let mut map = encode_map(bundle, &view).unwrap();
    let found = match_pair(bundle, &view, &mut map, &frame_view, &search, &mut Steps::start()).unwrap();
    let (coarse, quad) = (apart(&found.coarse.0, &expected.coarse), apart(&found.quad.0, &expected.quad));
    let homography = apart(&corners(found.homography.0), &corners(expected.homography));
    let flat = |d: &[[[f64; 2]; 2]; 2]| d.iter().flatten().flatten().copied().collect::<Vec<_>>();
    let displacement = largest(flat(&found.final_displacement), flat(&expected.final_displacement));
    println!(
        "same pixels: coarse {coarse:.2e}, quad {quad:.2e}, homography {homography:.2e} window px; final {displacement:.2e} px"
    );
    let tolerance = CORNER_TOLERANCE_PX * expected.m_per_px;
    assert!(coarse <= tolerance && quad <= tolerance && homography <= tolerance);
    assert!(displacement <= CORNER_TOLERANCE_PX);
}

/// The frame as PNG, the window from the GeoTIFF, the position through the geodesic, and back into the map's projection.
fn whole_way(folder: &Path, expected: &Expected, bundle: Bundle) {
    let map = GeoTiff::open(&folder.join("map.tif")).unwrap();
    let crs = map.crs().clone();
    let mut localizer = Localizer::new(bundle, MapCache::new(map, 64 << 20), open_gates(), budget()).unwrap();
    let png = std::fs::read(folder.join("frame.png")).unwrap();
    let at = |[lat_deg, lon_deg]: [f64; 2]| LatLon::new(lat_deg, lon_deg).unwrap();
    let prior = Prior {
        position: at(expected.centre),
        radius_m: 512.0,
        sigma_m: None,
        source: PriorSource::External,
        chain: 0,
        age_s: None,
    };
    let query = Query {
        stamp_ns: 0,
        frame: Ok(EncodedFrame { bytes: &png, encoding: Encoding::Png, size_px: None }),
        pose: Pose { gsd_m: Some(1.0), yaw_deg: Some(0.0), ..Pose::default() },
        prior: Ok(prior),
    };
    let fix = localizer.locate(&query).outcome.unwrap();
    let away_m = fix.position.distance_m(at(expected.position));
    let homography = apart(&corners(fix.homography), &corners(expected.homography));
    let (x, y) = crs.forward(fix.position).unwrap();
    let crs_m = largest([x, y], expected.map_crs);
    println!("whole way: homography {homography:.2e} window px, position {away_m:.2e} m, map CRS {crs_m:.2e} m");
    // The window is resampled here in fixed point, there in floating point: single pixels differ by one level.
    assert!(homography <= 4.0 * CORNER_TOLERANCE_PX * expected.m_per_px);
    assert!(away_m <= POSITION_TOLERANCE_M);
    assert!(crs_m <= POSITION_TOLERANCE_M);
}

/// Weights made by formula locate nothing: every gate on the result is open.
fn open_gates() -> GateSettings {
    GateSettings {
        enabled: false,
        min_map_valid: 0.9,
        min_frame_valid: 0.5,
        min_frame_std: 1.0,
        max_scale_error: 1.0,
        max_rotation_deg: 180.0,
        min_side_ratio: 0.0,
        min_peak_mass: 0.0,
        max_second_peak: 1.0,
        max_stage_shift_m: 1e4,
        max_refine_residual_m: 1e4,
        max_p_over_25m: 1.0,
        crops: false,
    }
}

fn budget() -> BudgetSettings {
    BudgetSettings {
        sigma_tilt_deg: 1.0,
        sigma_tilt_unknown_deg: 3.0,
        assumed_agl_m: 120.0,
        map_sigma_m: 2.0,
        sigma_stamp_s: 0.0,
        speed_mps: 0.0,
        floor_m: 1.0,
    }
}
