//! The ladder on a real map file: which bundle answers, when a region is searched, and what a search gives.

mod support;

use nightfix::config::{SearchSettings, Settings};
use nightfix::geo::{Enu, LatLon};
use nightfix::locate::{Answer, EncodedFrame, Ladder, LocateError, Prior, PriorSource, Query, Reason};
use nightfix::map::{GeoTiff, MapCache, WindowSpec};
use nightfix::model::{Bundle, Dim, Graph, Port};
use nightfix::thermal::{Encoding, Pose};
use nightfix::track::{PriorReport, Spread, Tracker};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use support::bundle::{FRAME_PX, Landscape, in_memory, runtime};
use support::map::{self, MAP_PX};
use support::onnx::{Attribute, Node, Size, model};

/// The fixture under another name and D_C.
fn rung(name: &str, search_radius_m: f64) -> Bundle {
    let mut bundle = in_memory(&runtime());
    (bundle.manifest.name, bundle.manifest.search_radius_m) = (name.to_owned(), search_radius_m);
    bundle
}

/// The fixture with a map encoder that takes one size only.
fn of_one_size(name: &str) -> Bundle {
    let pool = Node {
        op: "AveragePool",
        inputs: vec!["map"],
        outputs: vec!["map_features"],
        attributes: vec![("kernel_shape", Attribute::Ints(vec![2, 2])), ("strides", Attribute::Ints(vec![2, 2]))],
    };
    let fixed = |dims: [i64; 4]| dims.map(Size::Fixed).to_vec();
    let onnx = model(&[pool], &[], &[("map", fixed([1, 3, 112, 112]))], &[("map_features", fixed([1, 3, 56, 56]))]);
    let any = |name| Port { name, dims: vec![Dim::Any; 4] };
    let graph = Graph::new("coarse_map", &onnx, &runtime(), &[any("map")], &[any("map_features")]).unwrap();
    Bundle { coarse_map: graph, ..rung(name, 128.0) }
}

struct Bench {
    ladder: Ladder,
    maker: MapCache,
}

/// The map that most tests share.
fn landscape() -> PathBuf {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    let make = || {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("ladder-{}.tif", std::process::id()));
        map::write(&path, &Landscape::new(11), |_, _| false);
        path
    };
    MADE.get_or_init(make).clone()
}

fn search(max_radius_m: f64) -> SearchSettings {
    SearchSettings { max_radius_m, ..Settings::defaults().unwrap().search }
}

impl Bench {
    fn new(bundles: Vec<Bundle>, max_radius_m: f64) -> Self {
        Self::over(&landscape(), bundles, max_radius_m).unwrap()
    }
    fn over(map: &Path, bundles: Vec<Bundle>, max_radius_m: f64) -> Result<Self, LocateError> {
        let file = GeoTiff::open(map).unwrap();
        let Settings { gates, budget, .. } = Settings::defaults().unwrap();
        let mut bundles = bundles.into_iter();
        let first = bundles.next().unwrap();
        let ladder = Ladder::new(first, bundles.collect(), &file, 16 << 20, &gates, &budget, &search(max_radius_m))?;
        Ok(Self { ladder, maker: MapCache::new(file, 16 << 20) })
    }
    fn frame(&mut self, at: LatLon) -> Vec<u8> {
        let window = self.maker.window(&WindowSpec { centre: at, width_m: FRAME_PX as f64, m_per_px: 1.0 }).unwrap();
        let gray: Vec<u8> = window.rgb.chunks_exact(3).map(|p| p[0]).collect();
        png(&gray)
    }
    fn locate(&mut self, png: &[u8], pose: Pose, prior: Prior) -> Answer {
        self.locate_while(png, pose, prior, &|| true)
    }
    fn locate_while(&mut self, png: &[u8], pose: Pose, prior: Prior, go_on: &dyn Fn() -> bool) -> Answer {
        let frame = EncodedFrame { bytes: png, encoding: Encoding::Png, size_px: None };
        self.ladder.locate_within(&Query { stamp_ns: 0, frame: Ok(frame), pose, prior: Ok(prior) }, go_on).0
    }
}

fn png(gray: &[u8]) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let side = FRAME_PX as u32;
    image::write_buffer_with_format(&mut bytes, gray, side, side, image::ColorType::L8, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

fn nadir() -> Pose {
    Pose { gsd_m: Some(1.0), yaw_deg: Some(0.0), pitch_deg: Some(0.0), roll_deg: Some(0.0), ..Pose::default() }
}

fn prior(position: LatLon, radius_m: f64) -> Prior {
    Prior { position, radius_m, sigma_m: None, source: PriorSource::External, chain: 0, age_s: None }
}

fn middle() -> LatLon {
    map::position(MAP_PX as f64 / 2.0, MAP_PX as f64 / 2.0)
}

fn reason(answer: &Answer) -> Option<Reason> {
    answer.outcome.as_ref().err().map(|no_fix| no_fix.reason)
}

fn bundle(answer: &Answer) -> &str {
    answer.bundle.as_deref().unwrap()
}

#[test]
fn the_smallest_bundle_that_covers_the_disc_answers() {
    // Not in order, and the first is not the largest.
    let mut bench = Bench::new(vec![rung("middle", 90.0), rung("large", 128.0), rung("small", 40.0)], 0.0);
    assert_eq!(bench.ladder.name(), "small, middle, large");
    let frame = bench.frame(middle());
    for (radius_m, expected) in
        [(10.0, "small"), (40.0, "small"), (40.1, "middle"), (90.0, "middle"), (91.0, "large"), (128.0, "large")]
    {
        let answer = bench.locate(&frame, nadir(), prior(middle(), radius_m));
        assert_eq!(bundle(&answer), expected, "{radius_m} m");
        assert!(answer.outcome.unwrap().position.distance_m(middle()) < 5.0 && !answer.searched);
    }
    let answer = bench.locate(&frame, nadir(), prior(middle(), 128.1));
    assert_eq!((reason(&answer), bundle(&answer)), (Some(Reason::PriorTooWide), "large"));
    let answer = bench.locate(&frame, nadir(), prior(middle(), f64::NAN));
    assert_eq!(reason(&answer), Some(Reason::NoPrior));
}

#[test]
fn at_the_scale_of_a_low_frame_the_disc_is_narrower_and_the_next_bundle_answers() {
    let low = |name: &str, radius_m: f64| {
        let mut bundle = rung(name, radius_m);
        bundle.manifest.scale_range = Some([0.25, 1.0]);
        bundle
    };
    let mut bench = Bench::new(vec![low("small", 80.0), low("large", 128.0)], 0.0);
    let frame = bench.frame(middle());
    // Half the footprint: D_C is 40 m and 64 m.
    let pose = Pose { gsd_m: Some(0.5), ..nadir() };
    for (radius_m, expected) in [(39.0, "small"), (41.0, "large"), (63.0, "large")] {
        assert_eq!(bundle(&bench.locate(&frame, pose, prior(middle(), radius_m))), expected, "{radius_m} m");
    }
    // D_C holds the prior, the low frame does not; beyond D_C it is the prior.
    for (radius_m, expected) in
        [(70.0, Reason::FootprintTooSmall), (128.0, Reason::FootprintTooSmall), (128.1, Reason::PriorTooWide)]
    {
        let answer = bench.locate(&frame, pose, prior(middle(), radius_m));
        assert_eq!((reason(&answer), bundle(&answer)), (Some(expected), "large"), "{radius_m} m");
    }
}

#[test]
fn bundles_of_one_name_are_refused() {
    let error =
        Bench::over(&landscape(), vec![rung("a", 40.0), rung("b", 90.0), rung("a", 128.0)], 0.0).err().unwrap().to_string();
    assert!(error.contains("bundle `a`: name"), "{error}");
}

#[test]
fn an_ageing_prior_climbs_the_ladder_then_is_searched_then_is_stale() {
    let settings = Settings::defaults().unwrap().track;
    let (s, t0, max_age_s) = (1_000_000_000i64, 1_700_000_000_000_000_000i64, settings.max_prior_age_s as i64);
    let mut bench = Bench::new(vec![rung("small", 40.0), rung("large", 128.0)], 400.0);
    let mut tracker = Tracker::new(settings).with_search_radius_m(bench.ladder.largest().search_radius_m());
    tracker.report(PriorReport { stamp_ns: t0, position: middle(), spread: Spread::RadiusM(30.0), fix_seq: None });
    let frame = bench.frame(middle());
    let mut widest_m = 0.0;
    // At 25 m/s: 30, 80, 130, 280, 430 m.
    for (age_s, expected) in [
        (0, Ok(("small", false))),
        (2, Ok(("large", false))),
        (4, Ok(("large", true))),
        (10, Ok(("large", true))),
        (16, Err(Reason::PriorTooWide)),
        (max_age_s, Err(Reason::PriorTooWide)),
    ] {
        // Uncertainty grows either way from its stamp.
        for stamp_ns in [t0 + age_s * s, t0 - age_s * s] {
            let prior = tracker.prior_at(stamp_ns).unwrap();
            assert!(prior.radius_m >= widest_m, "never narrower: {prior:?}");
            widest_m = prior.radius_m;
            let answer = bench.locate(&frame, nadir(), prior);
            match expected {
                Ok((name, searched)) => {
                    assert_eq!((bundle(&answer), answer.searched), (name, searched), "{age_s} s: {:?}", answer.outcome);
                    assert!(answer.outcome.unwrap().position.distance_m(middle()) < 6.0, "{age_s} s");
                }
                Err(expected) => assert_eq!(reason(&answer), Some(expected), "{age_s} s"),
            }
        }
    }
    assert_eq!(tracker.prior_at(t0 + (max_age_s + 1) * s).unwrap_err().reason, Reason::StalePrior);
}

#[test]
fn a_region_is_searched_marked_and_encoded_once() {
    let mut bench = Bench::new(vec![rung("large", 128.0)], 400.0);
    assert_eq!(bench.ladder.search_kind(), "dense");
    let mut last = None;
    for (east_m, north_m) in [(0.0, 0.0), (210.0, -180.0), (-230.0, 60.0), (-150.0, 240.0)] {
        let truth = middle().offset(Enu { east_m, north_m });
        let frame = bench.frame(truth);
        // The prior's middle moves a little from frame to frame.
        let prior = prior(middle().offset(Enu { east_m: east_m / 20.0, north_m: 3.0 }), 330.0);
        let answer = bench.locate(&frame, nadir(), prior);
        let fix = answer.outcome.as_ref().unwrap();
        assert!(fix.position.distance_m(truth) < 6.0, "{} m: {:?}", fix.position.distance_m(truth), answer.evidence);
        assert!(answer.searched && !fix.calibrated && fix.p_over_25m.is_none());
        assert_eq!(answer.prior.unwrap(), prior, "the prior that was given is told");
        let number = |name: &str| answer.evidence[name];
        let off = prior.position.enu_to(fix.position);
        assert!((number("search_east_m") - off.east_m).abs() < 1e-9 && (number("search_north_m") - off.north_m).abs() < 1e-9);
        // Where a footprint of 128 m keeps 90 % on a map of 720 m: at most 618 m square.
        assert!((0.2..0.4).contains(&number("search_km2")), "{:?}", answer.evidence);
        assert!(number("search_second") <= 0.2 && (1.0..=3.0).contains(&number("search_peaks")) && number("search_mass") > 0.0);
        last = Some((frame, prior, answer));
    }
    // A tile owns 240 shifts of 8 m, from 960 m west and north of the map's middle: all of this map is one tile's.
    assert_eq!(bench.ladder.tiles_encoded(), 1);
    // By a fresh ladder: the same to the bit.
    let (frame, prior, answer) = last.unwrap();
    let again = Bench::new(vec![rung("large", 128.0)], 400.0).locate(&frame, nadir(), prior);
    assert_eq!((again.outcome, again.evidence), (answer.outcome, answer.evidence));
}

#[test]
fn an_unknown_yaw_is_searched_too() {
    let mut bench = Bench::new(vec![rung("large", 128.0)], 400.0);
    let truth = middle().offset(Enu { east_m: 190.0, north_m: 150.0 });
    let frame = bench.frame(truth);
    let answer = bench.locate(&frame, Pose { yaw_deg: None, ..nadir() }, prior(middle(), 300.0));
    let fix = answer.outcome.as_ref().unwrap();
    assert!(fix.position.distance_m(truth) < 6.0, "{:?}", answer.evidence);
    assert!(((fix.yaw_deg + 180.0).rem_euclid(360.0) - 180.0).abs() < 3.0, "{}", fix.yaw_deg);
}

#[test]
fn two_places_that_look_alike_are_ambiguous() {
    // The right half of the map repeats the left.
    let folder = tempfile::tempdir().unwrap();
    let half = MAP_PX / 2;
    let land = Landscape::new(11);
    map::write_levels(&folder.path().join("map.tif"), |x, y| land.level((x % half) as f64, y as f64));
    let mut bench = Bench::over(&folder.path().join("map.tif"), vec![rung("large", 128.0)], 400.0).unwrap();
    let frame = bench.frame(map::position(half as f64 / 2.0, half as f64));
    let answer = bench.locate(&frame, nadir(), prior(middle(), 330.0));
    assert_eq!(reason(&answer), Some(Reason::Ambiguous), "{:?} {:?}", answer.outcome, answer.evidence);
    assert!(answer.evidence["search_second"] > 0.5, "{:?}", answer.evidence);
    // A prior that tells them apart does not need a search.
    let answer = bench.locate(&frame, nadir(), prior(map::position(half as f64 / 2.0, half as f64), 120.0));
    assert!(answer.outcome.is_ok() && !answer.searched, "{:?}", answer.outcome);
}

#[test]
fn reasons_of_a_search_come_in_the_contracts_order() {
    let mut bench = Bench::new(vec![rung("large", 128.0)], 400.0);
    let good = bench.frame(middle());
    let flat = png(&[90; FRAME_PX * FRAME_PX]);
    let nowhere = prior(LatLon { lat_deg: 0.0, lon_deg: 0.0 }, 300.0);
    assert_eq!(reason(&bench.locate(b"no png", nadir(), prior(nowhere.position, 400.1))), Some(Reason::PriorTooWide));
    let answer = bench.locate(&good, nadir(), prior(middle(), 500.0));
    assert!(answer.outcome.unwrap_err().detail.contains("a search goes up to 400 m"));
    assert_eq!(reason(&bench.locate(b"no png", nadir(), nowhere)), Some(Reason::BadFrame));
    assert_eq!(reason(&bench.locate(&flat, nadir(), nowhere)), Some(Reason::OffMap));
    assert_eq!(reason(&bench.locate(&flat, nadir(), prior(middle(), 300.0))), Some(Reason::FlatFrame));
}

#[test]
fn a_search_that_is_stopped_is_a_deadline_and_what_was_encoded_stays() {
    let mut bench = Bench::new(vec![rung("large", 128.0)], 400.0);
    let frame = bench.frame(middle());
    let wide = prior(middle(), 300.0);
    let turns = std::cell::Cell::new(0);
    let twice = || {
        turns.set(turns.get() + 1);
        turns.get() <= 2
    };
    assert_eq!(reason(&bench.locate_while(&frame, nadir(), wide, &|| false)), Some(Reason::Deadline));
    assert_eq!(bench.ladder.tiles_encoded(), 0);
    // The tile and one of three places.
    let answer = bench.locate_while(&frame, nadir(), wide, &twice);
    assert_eq!((reason(&answer), bench.ladder.tiles_encoded()), (Some(Reason::Deadline), 1));
    assert!(answer.outcome.unwrap_err().detail.contains("1 of 3 places"));
    assert!(bench.locate(&frame, nadir(), wide).outcome.is_ok());
    assert_eq!(bench.ladder.tiles_encoded(), 1);
    // What needs no search is not stopped.
    assert!(bench.locate_while(&frame, nadir(), prior(middle(), 60.0), &|| false).outcome.is_ok());
}

#[test]
fn a_bundle_whose_map_encoder_takes_one_size_sweeps_windows() {
    let mut bench = Bench::new(vec![of_one_size("fixed")], 400.0);
    assert_eq!(bench.ladder.search_kind(), "sweep");
    let truth = middle().offset(Enu { east_m: 170.0, north_m: -160.0 });
    let frame = bench.frame(truth);
    let answer = bench.locate(&frame, nadir(), prior(middle(), 280.0));
    let fix = answer.outcome.as_ref().unwrap();
    assert!(answer.searched && fix.position.distance_m(truth) < 6.0, "{:?}", answer.evidence);
    assert!(answer.evidence["search_peaks"] >= 9.0, "{:?}", answer.evidence);
    let one = std::cell::Cell::new(0);
    let answer = bench.locate_while(&frame, nadir(), prior(middle(), 280.0), &|| one.replace(one.get() + 1) < 1);
    assert_eq!(reason(&answer), Some(Reason::Deadline));
}
