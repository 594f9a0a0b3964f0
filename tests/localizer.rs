//! The localizer on a real map file: positions, reasons in the contract's order, caches that change nothing.

mod support;

use nightfix::config::{GateSettings, Settings};
use nightfix::geo::{Enu, LatLon};
use nightfix::locate::{Answer, EncodedFrame, Localizer, NoFix, Prior, PriorSource, Query, Reason, StageName};
use nightfix::map::{GeoTiff, MapCache, WindowSpec};
use nightfix::model::{Integrity, Manifest};
use nightfix::thermal::{Encoding, FrameError, Pose};
use support::bundle::{FRAME_PX, Landscape, in_memory, runtime};
use support::map::{self, MAP_PX};

struct Bench {
    localizer: Localizer,
    /// The same map again, to cut frames from.
    maker: MapCache,
    _folder: tempfile::TempDir,
}

impl Bench {
    fn new(change: impl FnOnce(&mut GateSettings)) -> Self {
        Self::with_hole(change, |_, _| false)
    }
    fn with_hole(change: impl FnOnce(&mut GateSettings), absent: impl Fn(usize, usize) -> bool) -> Self {
        Self::with_manifest(change, absent, |_| ())
    }
    fn with_manifest(
        change: impl FnOnce(&mut GateSettings),
        absent: impl Fn(usize, usize) -> bool,
        state: impl FnOnce(&mut Manifest),
    ) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.tif");
        map::write(&path, &Landscape::new(11), absent);
        let cache = || MapCache::new(GeoTiff::open(&path).unwrap(), 16 << 20);
        let settings = Settings::defaults().unwrap();
        let mut gates = settings.gates.clone();
        change(&mut gates);
        let mut bundle = in_memory(&runtime());
        state(&mut bundle.manifest);
        let localizer = Localizer::new(bundle, cache(), gates, settings.budget.clone()).unwrap();
        Self { localizer, maker: cache(), _folder: folder }
    }
    /// What a nadir camera with image up = true north sees above a position.
    fn frame(&mut self, at: LatLon) -> Vec<u8> {
        let spec = WindowSpec { centre: at, width_m: FRAME_PX as f64, m_per_px: 1.0 };
        let window = self.maker.window(&spec).unwrap();
        png(FRAME_PX as u32, &window.rgb.chunks_exact(3).map(|p| p[0]).collect::<Vec<u8>>())
    }
    fn locate(&mut self, png: &[u8], pose: Pose, prior: Prior) -> Answer {
        let frame = EncodedFrame { bytes: png, encoding: Encoding::Png, size_px: None };
        self.localizer.locate(&Query { stamp_ns: 0, frame: Ok(frame), pose, prior: Ok(prior) })
    }
}

fn png(side: u32, gray: &[u8]) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::write_buffer_with_format(&mut bytes, gray, side, side, image::ColorType::L8, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

fn nadir() -> Pose {
    Pose { gsd_m: Some(1.0), yaw_deg: Some(0.0), pitch_deg: Some(0.0), roll_deg: Some(0.0), ..Pose::default() }
}

fn prior(position: LatLon, radius_m: f64) -> Prior {
    Prior { position, radius_m, sigma_m: None, source: PriorSource::External, chain: 0, age_s: None }
}

fn reason(answer: &Answer) -> Reason {
    answer.outcome.as_ref().map(|fix| format!("a fix at {:?}", fix.position)).expect_err("expected no fix").reason
}

fn middle() -> LatLon {
    map::position(MAP_PX as f64 / 2.0, MAP_PX as f64 / 2.0)
}

#[test]
fn a_frame_is_found_on_the_ellipsoid() {
    let mut bench = Bench::new(|_| ());
    for (east_m, north_m) in [(0.0, 0.0), (70.0, -40.0), (-55.0, 90.0)] {
        let truth = middle().offset(Enu { east_m, north_m });
        let frame = bench.frame(truth);
        let answer = bench.locate(&frame, nadir(), prior(middle(), 128.0));
        let fix = answer.outcome.as_ref().unwrap();
        let error_m = fix.position.distance_m(truth);
        assert!(error_m < 5.0, "{error_m} m: {:?}", answer.evidence);
        assert!(((fix.yaw_deg + 180.0).rem_euclid(360.0) - 180.0).abs() < 2.0 && (fix.scale - 1.0).abs() < 0.04, "{fix:?}");
        assert_eq!((fix.stage, fix.calibrated), (StageName::Refine, false));
        assert!((fix.homography[2][2] - 1.0).abs() < 1e-12);
        // The middle of the frame by the message's own numbers: homography, then the window's affine, then the CRS.
        let window = answer.window.unwrap();
        assert_eq!(window.width_m, 384.0);
        for name in ["sigma_match_m", "sigma_tilt_m", "peak_mass", "second_peak", "stage_shift_m", "map_valid", "frame_valid"] {
            assert!(answer.evidence.contains_key(name), "{name}: {:?}", answer.evidence);
        }
        assert!(answer.latency_ms.contains_key("total"));
    }
}

#[test]
fn a_low_frame_is_matched_at_the_scale_the_bundle_states() {
    // Half of the bundle's footprint.
    let truth = middle().offset(Enu { east_m: 14.0, north_m: -21.0 });
    let pose = Pose { gsd_m: Some(0.5), ..nadir() };
    let cut = |bench: &mut Bench| {
        let window = bench.maker.window(&WindowSpec { centre: truth, width_m: 64.0, m_per_px: 0.5 }).unwrap();
        png(128, &window.rgb.chunks_exact(3).map(|p| p[0]).collect::<Vec<u8>>())
    };
    let mut fixed = Bench::new(|_| ());
    let frame = cut(&mut fixed);
    assert_eq!(reason(&fixed.locate(&frame, pose, prior(middle(), 60.0))), Reason::FootprintTooSmall);

    let mut bench = Bench::with_manifest(|_| (), |_, _| false, |manifest| manifest.scale_range = Some([0.25, 1.0]));
    let answer = bench.locate(&frame, pose, prior(middle(), 60.0));
    let fix = answer.outcome.as_ref().unwrap();
    assert!(fix.position.distance_m(truth) < 3.0, "{} m, {:?}", fix.position.distance_m(truth), answer.evidence);
    assert_eq!(answer.evidence["matched_scale"], 0.5);
    // The message's homography and affine are between pixels of 1 m, whatever scale was matched at.
    let (window, h) = (answer.window.unwrap(), fix.homography);
    assert_eq!(window.width_m, 192.0);
    let middle_px = (FRAME_PX as f64 - 1.0) / 2.0;
    let [x, y] = [0, 1].map(|row| h[row][0] * middle_px + h[row][1] * middle_px + h[row][2]);
    let [a, b, c, d, e, f] = window.map_affine;
    let at = map::crs().inverse(a * x + b * y + c, d * x + e * y + f).unwrap();
    assert!(at.distance_m(fix.position) < 0.02, "{} m", at.distance_m(fix.position));
    let side = (h[0][0].hypot(h[1][0]) - 1.0).abs();
    assert!(side < 0.04, "a frame metre is a window metre: {h:?}");
    // D_C shrinks with it.
    assert_eq!(reason(&bench.locate(&frame, pose, prior(middle(), 64.5))), Reason::PriorTooWide);
    // A frame that shows enough is matched as ever.
    let whole = bench.frame(truth);
    assert_eq!(bench.locate(&whole, nadir(), prior(middle(), 128.0)).window.unwrap().width_m, 384.0);
}

/// A calibration that knows one cue: the probability falls with the peak's mass.
fn calibration(p: [f64; 2]) -> Integrity {
    let text = format!(
        "data = \"a\"\ncommand = \"b\"\ntrials = 9\nbound_m = 25.0\nbias = 0.0\nprobability = {{ scores = [-9.0, 9.0], p = {p:?} }}\n\
         sigma = {{ bias = 0.7, least_m = 0.5, most_m = 9.0, tail999 = 4.5 }}\n\
         cues = [{{ name = \"peak_mass\", transform = \"logit\", low = -9.0, high = 9.0, weight = -1.0, sigma_weight = 0.0 }}]"
    );
    toml::from_str(&text).unwrap()
}

#[test]
fn a_calibrated_bundle_states_its_error_and_its_gate_closes() {
    let truth = middle().offset(Enu { east_m: 20.0, north_m: 0.0 });
    let mut bench = Bench::with_manifest(|_| (), |_, _| false, |m| m.integrity = Some(calibration([0.001, 0.001])));
    let frame = bench.frame(truth);
    let answer = bench.locate(&frame, nadir(), prior(middle(), 128.0));
    let fix = answer.outcome.as_ref().unwrap();
    assert_eq!((fix.calibrated, fix.p_over_25m), (true, Some(0.001)));
    assert!((answer.evidence["sigma_match_m"] - 0.7f64.exp()).abs() < 1e-9);
    assert!((fix.radius999_m / fix.covariance_enu_m2[0][0].sqrt() - 4.5).abs() < 1e-9);
    for cue in ["crop_spread_m", "cycle_m", "cycle_mass", "gradient_agreement", "frame_texture", "map_texture", "mode_share"] {
        assert!(answer.evidence.get(cue).is_some_and(|v| v.is_finite()), "{cue}: {:?}", answer.evidence);
    }
    // An unknown yaw was not part of any calibration.
    let turned = bench.locate(&frame, Pose { yaw_deg: None, ..nadir() }, prior(middle(), 128.0));
    let turned = turned.outcome.unwrap();
    assert_eq!((turned.calibrated, turned.p_over_25m), (false, None));

    let doubtful = |m: &mut Manifest| m.integrity = Some(calibration([0.5, 0.5]));
    let mut bench = Bench::with_manifest(|_| (), |_, _| false, doubtful);
    assert_eq!(reason(&bench.locate(&frame, nadir(), prior(middle(), 128.0))), Reason::LowEvidence);
    let mut open = Bench::with_manifest(|gates| gates.enabled = false, |_, _| false, doubtful);
    let answer = open.locate(&frame, nadir(), prior(middle(), 128.0));
    assert_eq!(answer.withheld, Some(Reason::LowEvidence));
    let fix = answer.outcome.unwrap();
    assert_eq!((fix.calibrated, fix.p_over_25m), (false, None), "no calibration covers what a gate would have closed");
    // A cue that is missing closes the gate: what was not seen is not safe.
    let unknown = |m: &mut Manifest| {
        let mut table = calibration([0.001, 0.001]);
        table.cues[0].name = "not_there".into();
        m.integrity = Some(table);
    };
    let mut bench = Bench::with_manifest(|_| (), |_, _| false, unknown);
    assert_eq!(reason(&bench.locate(&frame, nadir(), prior(middle(), 128.0))), Reason::LowEvidence);
}

#[test]
fn an_unknown_yaw_comes_back() {
    let mut bench = Bench::new(|_| ());
    let truth = middle().offset(Enu { east_m: 30.0, north_m: 20.0 });
    let frame = bench.frame(truth);
    let answer = bench.locate(&frame, Pose { yaw_deg: None, ..nadir() }, prior(middle(), 128.0));
    let fix = answer.outcome.as_ref().unwrap();
    assert!(fix.position.distance_m(truth) < 5.0);
    assert!(((fix.yaw_deg + 180.0).rem_euclid(360.0) - 180.0).abs() < 3.0, "{}", fix.yaw_deg);
}

#[test]
fn reasons_come_in_the_contracts_order() {
    let mut bench = Bench::new(|_| ());
    let good = bench.frame(middle());
    let far = prior(LatLon { lat_deg: 0.0, lon_deg: 0.0 }, 100.0);
    let flat = png(128, &[90; 128 * 128]);

    for why in [Reason::NoPrior, Reason::StalePrior] {
        let query = Query { stamp_ns: 0, frame: Err(unreadable()), pose: Pose::default(), prior: Err(NoFix::new(why, "told")) };
        assert_eq!(reason(&bench.localizer.locate(&query)), why);
    }
    // Too wide, and unreadable, and off the map: the first in order is told.
    let wide = prior(far.position, 128.001);
    assert_eq!(reason(&bench.locate(b"no png", nadir(), wide)), Reason::PriorTooWide);
    assert_eq!(reason(&bench.locate(&good, nadir(), prior(middle(), f64::INFINITY))), Reason::PriorTooWide);
    assert_eq!(reason(&bench.locate(&good, nadir(), prior(middle(), f64::NAN))), Reason::NoPrior);
    assert_eq!(reason(&bench.locate(&good, nadir(), prior(LatLon { lat_deg: f64::NAN, lon_deg: 0.0 }, 9.0))), Reason::NoPrior);
    assert_eq!(reason(&bench.locate(b"no png", nadir(), far)), Reason::BadFrame);
    assert_eq!(reason(&bench.locate(&good, Pose { gsd_m: None, ..nadir() }, far)), Reason::BadFrame);
    assert_eq!(reason(&bench.locate(&flat, nadir(), far)), Reason::OffMap);
    assert_eq!(
        reason(&bench.locate(&flat, Pose { gsd_m: Some(0.3), ..nadir() }, prior(middle(), 50.0))),
        Reason::FootprintTooSmall
    );
    assert_eq!(reason(&bench.locate(&flat, nadir(), prior(middle(), 50.0))), Reason::FlatFrame);
    assert!(bench.locate(&good, nadir(), prior(middle(), 128.0 * (1.0 + 5e-7))).outcome.is_ok());
}

fn unreadable() -> FrameError {
    FrameError::Unreadable { file: "a.png".into(), why: "absent".into() }
}

#[test]
fn gates_behind_the_match_close_and_can_be_switched_off() {
    let truth = middle().offset(Enu { east_m: 20.0, north_m: 0.0 });
    type Change = fn(&mut GateSettings);
    let cases: [(Reason, Change); 5] = [
        (Reason::ImplausibleQuad, |gates| gates.max_scale_error = 0.0),
        (Reason::LowEvidence, |gates| (gates.min_peak_mass, gates.max_stage_shift_m) = (0.0, 0.0)),
        (Reason::LowEvidence, |gates| gates.max_refine_residual_m = 0.0),
        (Reason::LowEvidence, |gates| gates.min_peak_mass = 1.0),
        (Reason::Ambiguous, |gates| gates.max_second_peak = 0.0),
    ];
    for (expected, change) in cases {
        let mut bench = Bench::new(change);
        let frame = bench.frame(truth);
        let answer = bench.locate(&frame, nadir(), prior(middle(), 128.0));
        assert_eq!(reason(&answer), expected, "{:?}", answer.evidence);
        let mut open = Bench::new(|gates| {
            change(gates);
            gates.enabled = false;
        });
        assert!(open.locate(&frame, nadir(), prior(middle(), 128.0)).outcome.is_ok());
    }
}

#[test]
fn ground_without_map_under_the_fitted_quad_is_nodata() {
    // A hole as large as a quarter of the frame, right where it was taken; elsewhere the map is whole.
    let edge = MAP_PX / 2;
    let hole = |x: usize, y: usize| (edge..edge + 64).contains(&x) && (edge..edge + 64).contains(&y);
    let mut bench = Bench::with_hole(|_| (), hole);
    let mut whole = Bench::new(|_| ());
    let frame = whole.frame(middle());
    let answer = bench.locate(&frame, nadir(), prior(middle(), 40.0));
    assert_eq!(reason(&answer), Reason::Nodata, "{:?}", answer.evidence);
    assert!((answer.evidence["map_valid"] - 0.75).abs() < 0.06, "{:?}", answer.evidence);
}

#[test]
fn a_result_beyond_the_disc_is_outside_prior() {
    // The only candidates lie within 1 m; the sub-cell peak is drawn to the truth, 6 m off.
    let mut bench = Bench::new(|gates| (gates.min_peak_mass, gates.max_second_peak) = (0.0, 1e6));
    let truth = middle().offset(Enu { east_m: 6.0, north_m: 0.0 });
    let frame = bench.frame(truth);
    let answer = bench.locate(&frame, nadir(), prior(middle(), 1.0));
    assert_eq!(reason(&answer), Reason::OutsidePrior, "{:?}", answer.evidence);
}

#[test]
fn the_map_is_encoded_once_per_window_and_history_changes_nothing() {
    let mut bench = Bench::new(|_| ());
    let places: Vec<LatLon> =
        (0..5).map(|i| middle().offset(Enu { east_m: 4.0 * f64::from(i), north_m: -3.0 * f64::from(i) })).collect();
    let mut answers = Vec::new();
    for place in &places {
        let frame = bench.frame(*place);
        answers.push(bench.locate(&frame, nadir(), prior(*place, 30.0)).outcome.unwrap());
    }
    assert_eq!(bench.localizer.map_encodes(), 1);
    // Elsewhere in between, and then the last again: the same to the bit, by the same localizer and by a fresh one.
    let elsewhere = middle().offset(Enu { east_m: -140.0, north_m: 100.0 });
    let frame = bench.frame(elsewhere);
    bench.locate(&frame, nadir(), prior(elsewhere, 20.0));
    let last = bench.frame(places[4]);
    assert_eq!(bench.locate(&last, nadir(), prior(places[4], 30.0)).outcome.unwrap(), answers[4]);
    let mut fresh = Bench::new(|_| ());
    assert_eq!(fresh.locate(&last, nadir(), prior(places[4], 30.0)).outcome.unwrap(), answers[4]);
}

#[test]
fn odd_poses_are_answered() {
    let mut bench = Bench::new(|_| ());
    let frame = bench.frame(middle());
    for value in [f64::NAN, f64::INFINITY, -1.0, 0.0, 1e-300, 1e300, 89.9, 180.0] {
        for pose in [
            Pose { gsd_m: Some(value), ..nadir() },
            Pose { gsd_m: None, agl_m: Some(value), hfov_deg: Some(40.0), ..nadir() },
            Pose { gsd_m: None, agl_m: Some(300.0), hfov_deg: Some(value), ..nadir() },
            Pose { yaw_deg: Some(value), ..nadir() },
            Pose { pitch_deg: Some(value), agl_m: Some(200.0), ..nadir() },
            Pose { roll_deg: Some(value), ..nadir() },
        ] {
            // No panic, and no number that is none.
            if let Ok(fix) = bench.locate(&frame, pose, prior(middle(), 60.0)).outcome {
                assert!(fix.position.lat_deg.is_finite() && fix.radius95_m.is_finite() && fix.yaw_deg.is_finite(), "{pose:?}");
            }
        }
    }
}
