//! A real recorded flight, replayed over the map of another place: every frame is read, and none is placed.
//!
//! Needs the shared data; skips, and says so, where there are none.

mod support;

use nightfix::bus::{FixMessage, Status};
use nightfix::locate::Reason;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use support::bundle::{Landscape, runtime, write};
use support::map;

/// 33 nadir LWIR frames, raw 16 bit, of a place of which there is no map here.
fn guangzhou() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/flights/guangzhou");
    if !folder.join("flight.toml").is_file() {
        eprintln!("SKIPPED: no shared data: {} is not there", folder.display());
        return None;
    }
    Some(folder)
}

fn nightfix(words: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nightfix")).args(words).env_remove("RUST_LOG").output().unwrap()
}

#[test]
fn over_the_map_of_another_place_every_frame_is_off_map() {
    let Some(flight) = guangzhou() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    write(&folder.path().join("bundle"), &runtime());
    map::write(&folder.path().join("map.tif"), &Landscape::new(11), |_, _| false);
    let (flight, library) = (flight.display().to_string(), runtime().library().display().to_string());
    let done = nightfix(&[
        "replay",
        &flight,
        "--map",
        &path("map.tif"),
        "--bundle",
        &path("bundle"),
        "--out",
        &path("out"),
        "--onnxruntime",
        &library,
    ]);
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let lines = std::fs::read_to_string(path("out/fixes.jsonl")).unwrap();
    let fixes: Vec<serde_json::Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(fixes.len(), 33);
    for (i, mut line) in fixes.into_iter().enumerate() {
        assert_eq!(line["file"], format!("raw16/frame_{i:03}.png"));
        for key in ["file", "error_m"] {
            line.as_object_mut().unwrap().remove(key);
        }
        let fix: FixMessage = serde_json::from_value(line).unwrap();
        assert_eq!((fix.status, fix.reason), (Status::NoFix, Some(Reason::OffMap)), "{:?}", fix.detail);
    }
    let metrics: serde_json::Value = serde_json::from_slice(&std::fs::read(path("out/metrics.json")).unwrap()).unwrap();
    assert_eq!((&metrics["frames"], &metrics["fixes"], &metrics["no_fix"]["off_map"]), (&33.into(), &0.into(), &33.into()));
}

#[test]
fn all_of_its_frames_decode_tone_map_and_rectify() {
    let Some(flight) = guangzhou() else { return };
    let folder = tempfile::tempdir().unwrap();
    let sheet = folder.path().join("sheet.png").display().to_string();
    let flight = flight.display().to_string();
    let done = nightfix(&["frame", "--contact-sheet", &flight, "--width-m", "120", "--tile-px", "96", "--out", &sheet]);
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let report: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!((&report["frames"], &report["failed"]), (&33.into(), &serde_json::json!([])));
    // 107 m x 85 m of ground in a tile of 120 m.
    assert!(report["valid_fraction"].as_f64().unwrap() > 0.5, "{report}");
    // Every tile has a picture in it: no frame came out flat.
    let picture = image::open(&sheet).unwrap().into_luma8();
    let (columns, rows) = (picture.width() / 96, picture.height() / 96);
    let tile_std = |x0: u32, y0: u32| {
        let values = (0..96 * 96).map(|i| f64::from(picture.get_pixel(x0 + 16 + i % 64, y0 + 16 + i / 96 * 64 / 96).0[0]));
        let (n, sum, squares) = values.fold((0.0, 0.0, 0.0), |(n, s, q), v| (n + 1.0, s + v, q + v * v));
        (squares / n - (sum / n) * (sum / n)).max(0.0).sqrt()
    };
    let textured = (0..rows * columns).filter(|i| tile_std(i % columns * 96, i / columns * 96) > 5.0).count();
    assert_eq!(textured, 33, "{columns} x {rows} tiles");
}
