//! Windows of many kinds of GeoTIFF, compared with GDAL's pixels resampled by pyproj and NumPy (`tests/oracle/map_cases.py`).

mod oracle;

use nightfix::geo::LatLon;
use nightfix::map::{GeoTiff, MapCache, WindowSpec};
use std::path::Path;

/// One window that the oracle made.
struct Case {
    name: String,
    file: String,
    spec: WindowSpec,
    size_px: usize,
    rgb: Vec<f32>,
    valid: Vec<u8>,
}

fn cases(dir: &Path) -> Vec<Case> {
    let table = std::fs::read_to_string(dir.join("cases.tsv")).unwrap();
    let case = |line: &str| {
        let f: Vec<&str> = line.split('\t').collect();
        let number = |i: usize| f[i].parse::<f64>().unwrap();
        let centre = LatLon::new(number(2), number(3)).unwrap();
        let rgb = std::fs::read(dir.join(format!("{}.rgb", f[0]))).unwrap();
        Case {
            name: f[0].into(),
            file: f[1].into(),
            spec: WindowSpec { centre, width_m: number(4), m_per_px: number(5) },
            size_px: f[6].parse().unwrap(),
            rgb: rgb.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            valid: std::fs::read(dir.join(format!("{}.valid", f[0]))).unwrap(),
        }
    };
    table.lines().map(case).collect()
}

/// What a case may differ by.
struct Tolerance {
    mean: f64,
    max: f64,
    /// Share of pixels whose validity may differ (weights are resolved to 1/256 px).
    valid: f64,
}

fn check_group(group: &str, tolerance: impl Fn(&str) -> Tolerance) {
    let dir = oracle::run("map_cases.py", &[group]);
    let cases = cases(dir.path());
    assert!(cases.len() > 5, "the oracle made {} cases", cases.len());
    let mut failures = Vec::new();
    for case in &cases {
        let allowed = tolerance(&case.name);
        let map = GeoTiff::open(&dir.path().join(&case.file)).unwrap_or_else(|e| panic!("{}: {e}", case.name));
        let window = match MapCache::new(map, 8 << 20).window(&case.spec) {
            Ok(window) => window,
            Err(e) => {
                failures.push(format!("{}: {e}", case.name));
                continue;
            }
        };
        assert_eq!(window.size_px, case.size_px, "{}", case.name);
        let differing = window.valid.iter().zip(&case.valid).filter(|(a, b)| a != b).count() as f64 / case.valid.len() as f64;
        let both = |i: usize| window.valid[i / 3] == 1 && case.valid[i / 3] == 1;
        let differences: Vec<f64> = (0..window.rgb.len())
            .filter(|&i| both(i))
            .map(|i| (f64::from(window.rgb[i]) - f64::from(case.rgb[i])).abs())
            .collect();
        let mean = differences.iter().sum::<f64>() / differences.len().max(1) as f64;
        let max = differences.iter().copied().fold(0.0, f64::max);
        if differing > allowed.valid || mean > allowed.mean || max > allowed.max {
            failures.push(format!("{}: mean {mean:.3}, max {max:.1}, validity differs on {differing:.4}", case.name));
        }
        let black = window.valid.iter().zip(window.rgb.as_chunks::<3>().0).all(|(v, p)| *v == 1 || *p == [0; 3]);
        assert!(black, "{}: an invalid pixel has a colour", case.name);
        eprintln!("{:24} mean {mean:.3} max {max:.1} valid {:.3}", case.name, window.valid_fraction());
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

const EXACT: Tolerance = Tolerance { mean: 0.35, max: 2.5, valid: 0.002 };

#[test]
fn every_packing_reads_as_gdal_reads_it() {
    check_group("packings", |_| EXACT);
}

#[test]
fn jpeg_reads_as_gdal_reads_it_but_for_chroma_upsampling() {
    check_group("jpegs", |_| Tolerance { mean: 1.0, max: 16.0, valid: 0.002 });
}

#[test]
fn nodata_alpha_masks_sparse_tiles_and_edges_are_invalid() {
    check_group("validity", |_| EXACT);
}

#[test]
fn sixteen_bits_follow_the_documented_rule() {
    check_group("depths", |_| EXACT);
}

#[test]
fn every_system_is_placed_as_proj_places_it() {
    check_group("places", |_| EXACT);
}

#[test]
fn coarser_windows_are_averaged_not_aliased() {
    check_group("scales", |name| match name {
        // An overview's pixels stand where they stand: between them there is only interpolation. Windows
        // are read at 1 m/px by every shipped bundle; these are coarser.
        "area_overview_9.0" => Tolerance { mean: 10.0, max: 45.0, valid: 0.0 },
        _ if name.starts_with("area_overview") => Tolerance { mean: 4.0, max: 20.0, valid: 0.0 },
        _ if name.starts_with("area") => Tolerance { mean: 2.0, max: 12.0, valid: 0.0 },
        _ => EXACT,
    });
}
