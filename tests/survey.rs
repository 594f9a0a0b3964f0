//! `nightfix survey`, the built binary: results that rasterio reads, the same after a stop, no mixing of surveys.

mod oracle;
mod support;

use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};
use support::bundle::{Landscape, runtime, write};
use support::map::{self, MAP_PX};

/// A camera that sees the fixture's 128 m: 200 x 160 m of ground.
const CAMERA: [&str; 6] = ["--agl-m", "145", "--width", "160", "--height", "128"];

fn survey(folder: &Path, out: &str, extra: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nightfix"));
    command.current_dir(folder).arg("--onnxruntime").arg(runtime().library());
    command.args(["survey", "--map", "map.tif", "--bundle", "bundle", "--out", out, "--cell-m", "180"]);
    command.args(["--frames-per-cell", "2"]).args(CAMERA).args(extra);
    command.env_remove("RUST_LOG").output().unwrap()
}

fn summary(output: &Output) -> Value {
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON object on stdout")
}

#[test]
fn a_survey_is_georeferenced_goes_on_where_it_stopped_and_is_not_mixed_with_another() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    write(&folder.join("bundle"), &runtime());
    map::write(&folder.join("map.tif"), &Landscape::new(11), |x, _| x >= 540);
    let whole = summary(&survey(folder, "whole", &[]));
    assert_eq!((&whole["cells"], &whole["cells_with_frames"]), (&16.into(), &12.into()), "{whole}");
    let read = |out: &str, file: &str| std::fs::read(folder.join(out).join(file)).unwrap();

    // As another program reads it: 4 x 4 cells of 180 m from the map's own corner.
    let seen = oracle::run("survey_tif.py", &[folder.join("whole/survey.tif").to_str().unwrap()]);
    let seen: Value = serde_json::from_slice(&std::fs::read(seen.path().join("survey.json")).unwrap()).unwrap();
    assert_eq!((&seen["epsg"], &seen["size"]), (&32640.into(), &serde_json::json!([4, 4])));
    assert_eq!(seen["transform"], serde_json::json!([180.0, 0.0, 322_400.0, 0.0, -180.0, 2_789_300.0]));
    assert_eq!(seen["types"], serde_json::json!(["float32", "float32", "float32"]));
    assert_eq!(seen["names"], serde_json::json!(["coverage", "median_error_m", "median_radius95_m"]));
    assert_eq!((&seen["nodata_is_nan"], &seen["area"]), (&true.into(), &"Area".into()));

    // The table says the same, cell by cell; the cells without map have no frames.
    let table = read("whole", "survey.csv");
    let mut table = csv::Reader::from_reader(table.as_slice());
    let rows: Vec<csv::StringRecord> = table.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 16);
    for (i, row) in rows.iter().enumerate() {
        assert_eq!((row[0].parse(), row[1].parse()), (Ok(i / 4), Ok(i % 4)));
        let centre = map::position(180.0 * (i % 4) as f64 + 89.5, 180.0 * (i / 4) as f64 + 89.5);
        assert!((row[2].parse::<f64>().unwrap() - centre.lat_deg).abs() < 1e-6);
        assert_eq!(&row[4], if i % 4 == 3 { "0" } else { "2" });
        match seen["bands"][0][i].as_f64() {
            Some(coverage) => assert!((coverage - row[6].parse::<f64>().unwrap()).abs() < 1e-3),
            None => assert_eq!(&row[6], ""),
        }
    }
    assert_eq!(MAP_PX, 720);
    let picture = image::load_from_memory(&read("whole", "survey.png")).unwrap();
    assert!(picture.width() >= 700, "{}", picture.width());

    // Stopped in the middle of a line: what was done is kept, the rest comes out the same.
    let journal = String::from_utf8(read("whole", "journal.jsonl")).unwrap();
    assert_eq!(journal.lines().count(), 17);
    std::fs::create_dir(folder.join("stopped")).unwrap();
    let cut: usize = journal.lines().take(8).map(|line| line.len() + 1).sum::<usize>() + 25;
    std::fs::write(folder.join("stopped/journal.jsonl"), &journal[..cut]).unwrap();
    assert_eq!(summary(&survey(folder, "stopped", &[])), whole);
    for file in ["survey.csv", "survey.tif", "survey.png", "journal.jsonl"] {
        assert!(read("stopped", file) == read("whole", file), "{file}");
    }

    // Another seed, or another radius, is another survey.
    for (option, value) in [("seed", "2"), ("radius-m", "64")] {
        let refused = survey(folder, "whole", &[&format!("--{option}"), value]);
        let text = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert_eq!(refused.status.code(), Some(2), "{text}");
        let field = option.replace('-', "_");
        assert!(text.contains("of another survey") && text.contains(&format!("{field}: expected {value}")), "{text}");
    }
    let refused = survey(folder, "new", &["--scale-noise", "0.9"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--scale-noise: expected 0 to 0.5, found 0.9"));
}
