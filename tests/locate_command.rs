//! `nightfix locate`, the built binary: JSON on stdout and nothing else, exit codes, pictures.

mod support;

use nightfix::bus::{FixMessage, Status};
use nightfix::geo::LatLon;
use nightfix::locate::Reason;
use nightfix::map::{GeoTiff, MapCache, WindowSpec};
use std::path::Path;
use std::process::{Command, Output};
use support::bundle::{FRAME_PX, Landscape, runtime, write};
use support::map::{self, MAP_PX};

fn truth() -> LatLon {
    map::position(MAP_PX as f64 / 2.0 + 31.0, MAP_PX as f64 / 2.0 - 12.0)
}

/// Bundle, map and a frame taken at [`truth`].
fn prepare(folder: &Path) {
    write(&folder.join("bundle"), &runtime());
    map::write(&folder.join("map.tif"), &Landscape::new(11), |_, _| false);
    let mut cache = MapCache::new(GeoTiff::open(&folder.join("map.tif")).unwrap(), 16 << 20);
    let spec = WindowSpec { centre: truth(), width_m: FRAME_PX as f64, m_per_px: 1.0 };
    let window = cache.window(&spec).unwrap();
    let gray: Vec<u8> = window.rgb.chunks_exact(3).map(|p| p[0]).collect();
    let side = FRAME_PX as u32;
    image::save_buffer(folder.join("frame.png"), &gray, side, side, image::ColorType::L8).unwrap();
}

fn locate(folder: &Path, extra: &[&str]) -> Output {
    let at = map::position(MAP_PX as f64 / 2.0, MAP_PX as f64 / 2.0);
    let mut command = Command::new(env!("CARGO_BIN_EXE_nightfix"));
    command.current_dir(folder).args(["locate", "--map", "map.tif", "--bundle", "bundle"]);
    if !extra.contains(&"--frame") {
        command.args(["--frame", "frame.png"]);
    }
    if !extra.contains(&"--onnxruntime") {
        command.arg("--onnxruntime").arg(runtime().library());
    }
    command.args(["--lat", &at.lat_deg.to_string(), "--lon", &at.lon_deg.to_string()]).args(extra);
    command.env_remove("RUST_LOG").output().unwrap()
}

fn message(output: &Output) -> FixMessage {
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON message and nothing else on stdout")
}

#[test]
fn a_frame_is_located() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path());
    let yaw = ["--yaw-deg", "0", "--pitch-deg", "0", "--roll-deg", "0"];
    let found = message(&locate(folder.path(), &[&yaw[..], &["--json", "--stamp-ns", "77", "--dump", "seen"]].concat()));
    assert_eq!((found.status, found.stamp_ns, found.seq), (Status::Fix, 77, 0));
    assert!(found.position().unwrap().distance_m(truth()) < 5.0, "{found:?}");
    assert_eq!((found.bundle.as_str(), found.map.name.as_str(), found.map.digest.len()), ("fixture", "map.tif", 64));
    let prior = found.prior.unwrap();
    assert_eq!((prior.radius_m, prior.chain), (128.0, 0), "D_C of the bundle by default");
    for (name, side) in [("window.png", 384), ("frame.png", FRAME_PX as u32)] {
        assert_eq!(image::open(folder.path().join("seen").join(name)).unwrap().width(), side);
    }
    // With no yaw the whole circle is searched.
    let found = message(&locate(folder.path(), &["--json"]));
    assert!(found.position().unwrap().distance_m(truth()) < 5.0, "{found:?}");

    let line = locate(folder.path(), &yaw);
    let text = String::from_utf8(line.stdout).unwrap();
    assert!(text.starts_with("fix ") && text.contains("uncalibrated") && text.lines().count() == 1, "{text}");
}

#[test]
fn no_fix_is_an_answer_and_ends_with_0() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path());
    std::fs::write(folder.path().join("broken.png"), b"no picture").unwrap();
    for (extra, expected) in [
        (&["--json", "--radius-m", "5000"][..], Reason::PriorTooWide),
        (&["--json", "--frame", "broken.png"], Reason::BadFrame),
        (&["--json", "--agl-m", "120"], Reason::BadFrame),
        (&["--json", "--gsd-m", "0.1"], Reason::FootprintTooSmall),
    ] {
        let found = message(&locate(folder.path(), extra));
        assert_eq!((found.status, found.reason), (Status::NoFix, Some(expected)), "{extra:?}");
        assert!(found.lat_deg.is_none() && found.homography.is_none() && found.detail.is_some());
    }
    let text = String::from_utf8(locate(folder.path(), &["--gsd-m", "0.1"]).stdout).unwrap();
    assert!(text.starts_with("no fix: footprint_too_small: "), "{text}");
}

#[test]
fn what_cannot_be_tried_ends_with_2_and_says_why() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path());
    for (extra, says) in [
        (&["--frame", "absent.png"][..], "absent.png"),
        (&["--frame", "frame.gif"], "frame.gif"),
        (&["--frame", "bundle"], "bundle"),
        (&["--radius-m=-3"], "radius-m"),
        (&["--config", "absent.toml"], "absent.toml"),
        (&["--gates", "ajar"], "ajar"),
        (&["--onnxruntime", "/no/such/libonnxruntime.so"], "/no/such/libonnxruntime.so"),
    ] {
        let output = locate(folder.path(), extra);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{extra:?}: {stderr}");
        assert!(stderr.contains(says) && output.stdout.is_empty(), "{extra:?}: {stderr}");
    }
    std::fs::write(folder.path().join("bundle/bundle.toml"), "schema = 1").unwrap();
    let output = locate(folder.path(), &[]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("bundle.toml"));
}
