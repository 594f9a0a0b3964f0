use super::*;
use crate::bus::{MapId, Status, WindowMessage};
use crate::thermal::Pose;
use proptest::prelude::*;

const CENTRE: LatLon = LatLon { lat_deg: 25.2, lon_deg: 55.3 };

fn row(truth: Option<LatLon>, yaw_deg: f64, truth_yaw_deg: Option<f64>) -> Row {
    let pose = Pose { yaw_deg: Some(yaw_deg), ..Pose::default() };
    Row { file: "f.png".into(), stamp_ns: 0, pose, prior: None, truth, truth_yaw_deg }
}

/// A message in a 1536 m window about [`CENTRE`].
fn message(fix: Option<LatLon>, reason: Option<Reason>, homography: Option<[[f64; 3]; 3]>, total_ms: f64) -> FixMessage {
    FixMessage {
        stamp_ns: 0,
        seq: 0,
        status: if fix.is_some() { Status::Fix } else { Status::NoFix },
        reason,
        withheld: None,
        detail: None,
        lat_deg: fix.map(|f| f.lat_deg),
        lon_deg: fix.map(|f| f.lon_deg),
        covariance_enu_m2: None,
        radius95_m: None,
        radius999_m: None,
        calibrated: false,
        p_over_25m: None,
        yaw_deg: None,
        scale: None,
        searched: false,
        stage: None,
        window_m: Some(1536.0),
        homography,
        window: Some(WindowMessage { lat_deg: CENTRE.lat_deg, lon_deg: CENTRE.lon_deg, width_m: 1536.0, map_affine: [0.0; 6] }),
        evidence: Default::default(),
        bundle: "b".into(),
        map: MapId { name: "m.tif".into(), digest: "0".into() },
        prior: None,
        latency_ms: [("total".to_owned(), total_ms)].into(),
    }
}

fn east(metres: f64) -> LatLon {
    CENTRE.offset(Enu { east_m: metres, north_m: 0.0 })
}

#[test]
fn every_key_is_there_without_any_frame() {
    let value = serde_json::to_value(Tally::default().metrics()).expect("JSON");
    let expected = serde_json::json!({
        "frames": 0, "fixes": 0, "coverage": 0.0, "no_fix": {}, "scored": 0,
        "error_m": {"median": null, "mean": null, "p95": null, "p99": null, "max": null},
        "over_25m": null, "over_50m": null, "mace_m": null, "latency_ms": {},
    });
    assert_eq!(value, expected);
}

#[test]
fn a_hand_counted_flight() {
    let mut tally = Tally::default();
    // numpy.percentile([0, 10, 25, 30, 60], [50, 95, 99]) = [25, 54, 58.8]; "over" is strict.
    for metres in [10.0, 0.0, 60.0, 30.0] {
        let error = tally.add(&row(Some(CENTRE), 0.0, None), &message(Some(east(metres)), None, None, metres));
        assert!((error.expect("an error") - metres).abs() < 1e-6);
    }
    tally.add(&row(Some(east(25.0)), 0.0, None), &message(Some(CENTRE), None, None, 1.0));
    assert_eq!(tally.add(&row(None, 0.0, None), &message(Some(CENTRE), None, None, 1.0)), None);
    for reason in [Reason::OffMap, Reason::BadFrame, Reason::OffMap] {
        assert_eq!(tally.add(&row(Some(CENTRE), 0.0, None), &message(None, Some(reason), None, 1.0)), None);
    }
    let m = tally.metrics();
    assert_eq!((m.frames, m.fixes, m.scored), (9, 6, 5));
    assert_eq!(m.coverage, 6.0 / 9.0);
    assert_eq!(serde_json::to_value(&m.no_fix).expect("JSON"), serde_json::json!({"off_map": 2, "bad_frame": 1}));
    let found = [m.error_m.median, m.error_m.mean, m.error_m.p95, m.error_m.p99, m.error_m.max].map(|v| v.expect("a number"));
    for (found, expected) in found.iter().zip([25.0, 25.0, 54.0, 58.8, 60.0]) {
        assert!((found - expected).abs() < 1e-5, "{found} {expected}");
    }
    // 25 m by geodesic arithmetic is 25 within a nanometre; do not lean on which side.
    assert!(m.over_25m == Some(0.4) || m.over_25m == Some(0.6), "{:?}", m.over_25m);
    assert_eq!((m.over_50m, m.mace_m), (Some(0.2), None));
    assert_eq!(m.latency_ms.get("total").map(|l| l.max), Some(60.0));
}

#[test]
fn corners_of_a_perfect_fit_are_zero_apart_and_know_which_way_yaw_turns() {
    // Truly image up was east, reported north: the rectified frame's top shows the ground to the east, its left the
    // north. Frame (x, y) is then seen at window (1023 - y, x + 512).
    let turned = [[0.0, -1.0, 1023.0], [1.0, 0.0, 512.0], [0.0, 0.0, 1.0]];
    let straight = [[1.0, 0.0, 512.0], [0.0, 1.0, 512.0], [0.0, 0.0, 1.0]];
    let mace = |yaw, truth_yaw, h| {
        let mut tally = Tally::default();
        tally.add(&row(Some(CENTRE), yaw, Some(truth_yaw)), &message(Some(CENTRE), None, Some(h), 1.0));
        tally.metrics().mace_m.expect("a number")
    };
    assert!(mace(0.0, 90.0, turned) < 1e-4);
    assert!(mace(123.0, 123.0, straight) < 1e-4);
    assert!(mace(350.0, 80.0, turned) < 1e-4);
    // A quarter turn the wrong way puts every corner on the opposite one's place: 512 sqrt(2) m.
    assert!((mace(90.0, 0.0, turned) - 512.0 * 2.0_f64.sqrt()).abs() < 0.1);
    let shifted = [[1.0, 0.0, 512.0 + 3.0], [0.0, 1.0, 512.0 - 4.0], [0.0, 0.0, 1.0]];
    assert!((mace(0.0, 0.0, shifted) - 5.0).abs() < 1e-3);
}

#[test]
fn thresholds_fail_on_the_wrong_side_and_on_null() {
    let mut tally = Tally::default();
    for metres in [1.0, 2.0, 60.0] {
        tally.add(&row(Some(CENTRE), 0.0, None), &message(Some(east(metres)), None, None, 1.0));
    }
    let metrics = tally.metrics();
    let all = |c, m, o| Thresholds { min_coverage: c, max_median_m: m, max_over_50m: o };
    assert!(all(Some(1.0), Some(2.01), Some(0.34)).failures(&metrics).is_empty());
    assert!(all(None, None, None).failures(&metrics).is_empty());
    assert_eq!(all(Some(1.01), Some(1.99), Some(0.33)).failures(&metrics).len(), 3);
    assert_eq!(all(Some(f64::NAN), Some(f64::NAN), Some(f64::NAN)).failures(&metrics).len(), 3);
    let nothing = Tally::default().metrics();
    assert_eq!(all(Some(0.0), Some(1e9), Some(1.0)).failures(&nothing).len(), 2);
}

proptest! {
    /// Against the definition: the value whose rank is `share * (n - 1)`, linear between neighbours.
    #[test]
    fn percentiles_are_linear_and_monotone(mut values in prop::collection::vec(-1e3..1e3f64, 1..40), share in 0.0..=1.0f64) {
        let found = percentile(&values, share).expect("a number");
        values.sort_by(f64::total_cmp);
        let place = share * (values.len() - 1) as f64;
        let (low, high) = (values[place.floor() as usize], values[place.ceil() as usize]);
        prop_assert!(low <= found + 1e-9 && found <= high + 1e-9);
        prop_assert!((found - (low * (1.0 - place.fract()) + high * place.fract())).abs() < 1e-9);
    }
}
