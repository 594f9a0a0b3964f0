//! `nightfix simulate`, the built binary: a flight folder that holds what it promises.

use nightfix::flight::Flight;
use nightfix::geo::LatLon;
use std::path::Path;
use std::process::{Command, Output};

fn simulate(out: &Path, extra: &[&str]) -> Output {
    let size = ["--world-size-m", "1400", "--world-m-per-px", "4", "--width", "160", "--height", "128"];
    Command::new(env!("CARGO_BIN_EXE_nightfix"))
        .arg("simulate")
        .arg("--out")
        .arg(out)
        .args(size)
        .args(extra)
        .output()
        .expect("the binary runs")
}

const NOISY: [&str; 14] = [
    "--world",
    "7",
    "--seed",
    "3",
    "--frames",
    "4",
    "--radius-m",
    "300",
    "--yaw-noise-deg",
    "5",
    "--scale-noise",
    "0.05",
    "--attitude-noise-deg",
    "1",
];

#[test]
fn the_same_seeds_give_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    for out in [&a, &b] {
        let done = simulate(out, &NOISY);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
    let files =
        ["flight.toml", "poses.csv", "truth.csv", "world.tif", "world_classes.tif", "frames/00000.png", "frames/00003.png"];
    for file in files {
        let read = |folder: &Path| std::fs::read(folder.join(file)).expect(file);
        assert!(read(&a) == read(&b), "{file} differs");
    }
}

#[test]
fn rows_keep_to_the_errors_that_were_asked_for() {
    let folder = tempfile::tempdir().expect("a folder");
    let done = simulate(folder.path(), &NOISY);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let report: serde_json::Value = serde_json::from_slice(&done.stdout).expect("JSON on standard output");
    assert_eq!(report["frames"], 4);
    let flight = Flight::open(folder.path()).expect("a flight that replay reads");
    assert!(flight.warnings.is_empty());
    assert_eq!(flight.map.as_deref(), Some(folder.path().join("world.tif").as_path()));
    assert_eq!(flight.rows.len(), 4);
    let true_gsd_m = report["gsd_m"].as_f64().expect("a number");
    let mut turned = 0.0_f64;
    for row in &flight.rows {
        let (truth, prior) = (row.truth.expect("truth"), row.prior.expect("a prior"));
        assert!(truth.distance_m(prior.position) <= 300.001);
        let error = row.pose.yaw_deg.expect("yaw") - row.truth_yaw_deg.expect("true yaw");
        let error = (error + 540.0).rem_euclid(360.0) - 180.0;
        assert!(error.abs() <= 5.001, "{error}");
        turned = turned.max(error.abs());
        let scale = row.pose.gsd_m.expect("m/px") / true_gsd_m;
        assert!((scale - 1.0).abs() <= 0.0501, "{scale}");
        assert!((row.pose.agl_m.expect("height") / 580.0 - scale).abs() < 1e-4);
        assert_eq!((row.pose.pitch_deg, row.pose.roll_deg), (None, None));
        let image = image::open(folder.path().join(&row.file)).expect("a frame");
        assert_eq!(image.color(), image::ColorType::L16);
        let counts = image.into_luma16();
        assert_eq!(counts.dimensions(), (160, 128));
        assert!(counts.pixels().all(|p| p.0[0] < 1 << 14));
        let distinct: std::collections::HashSet<u16> = counts.pixels().map(|p| p.0[0]).collect();
        assert!(distinct.len() > 50, "{} grey levels", distinct.len());
    }
    assert!(turned > 0.1);
}

#[test]
fn lanes_cover_the_ground_and_look_along_the_track() {
    let folder = tempfile::tempdir().expect("a folder");
    let done = simulate(
        folder.path(),
        &[
            "--world",
            "7",
            "--frames",
            "9",
            "--trajectory",
            "lawnmower",
            "--lane-m",
            "200",
            "--agl-m",
            "290",
            "--prior-every",
            "3",
        ],
    );
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let rows = Flight::open(folder.path()).expect("a flight").rows;
    let given: Vec<bool> = rows.iter().map(|r| r.prior.is_some()).collect();
    assert_eq!(given, [true, false, false, true, false, false, true, false, false]);
    let truths: Vec<LatLon> = rows.iter().map(|r| r.truth.expect("truth")).collect();
    for (pair, row) in truths.windows(2).zip(rows.windows(2)) {
        let seconds = (row[1].stamp_ns - row[0].stamp_ns) as f64 / 1e9;
        // Lane changes cut corners, so the flown way is at most what speed and time allow.
        let metres = pair[0].distance_m(pair[1]);
        assert!(metres > 1.0 && metres <= 20.0 * seconds + 0.5, "{metres} m in {seconds} s");
    }
    assert!((rows[0].truth_yaw_deg.expect("yaw") - 90.0).abs() < 1e-3, "the first lane leads east");
}

#[test]
fn a_map_of_its_own_is_not_named_in_the_flight() {
    let folder = tempfile::tempdir().expect("a folder");
    let (first, second) = (folder.path().join("a"), folder.path().join("b"));
    assert!(simulate(&first, &["--world", "7", "--frames", "1"]).status.success());
    let map = first.join("world.tif");
    let done = simulate(&second, &["--map", map.to_str().expect("a path"), "--frames", "2"]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let report: serde_json::Value = serde_json::from_slice(&done.stdout).expect("JSON");
    assert_eq!((&report["map"], &report["classes"]), (&"world.tif".into(), &true.into()));
    assert_eq!(Flight::open(&second).expect("a flight").map, None);
}

#[test]
fn what_cannot_be_is_refused_with_exit_2() {
    let folder = tempfile::tempdir().expect("a folder");
    for (extra, named) in [
        (vec!["--frames", "1"], "--map"),
        (vec!["--world", "1", "--frames", "0"], "frames"),
        (vec!["--world", "1", "--agl-m", "0"], "agl-m"),
        (vec!["--world", "1", "--scale-noise", "0.9"], "scale-noise"),
        (vec!["--world", "1", "--agl-m", "5000"], "lies nowhere whole on the map"),
        (vec!["--map", "absent.tif"], "absent.tif"),
    ] {
        let done = simulate(folder.path(), &extra);
        assert_eq!(done.status.code(), Some(2), "{extra:?}");
        let text = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(text.contains(named), "{extra:?}: {text}");
    }
}
