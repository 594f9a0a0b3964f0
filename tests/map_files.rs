//! Maps as files: written and read back, kept in the cache, real ones, large ones.

mod oracle;

use nightfix::geo::{Affine, Crs, Enu, LatLon};
use nightfix::map::{GeoTiff, MapCache, WindowSpec, write_rgb};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A map whose colours say where a pixel is.
fn ramp(width: usize, height: usize) -> Vec<u8> {
    (0..width * height)
        .flat_map(|i| [(i % width / 4) as u8, (i / width / 4) as u8, ((i % width + i / width) / 8) as u8])
        .collect()
}

fn dubai(dir: &Path, width: usize, height: usize) -> PathBuf {
    let path = dir.join("map.tif");
    let affine = Affine([1.0, 0.0, 344_000.5, 0.0, -1.0, 2_790_000.5]);
    write_rgb(&path, &ramp(width, height), width, height, &affine, &Crs::from_epsg(32640).unwrap()).unwrap();
    path
}

#[test]
fn what_is_written_is_read_back_in_its_place() {
    let dir = tempfile::tempdir().unwrap();
    let (width, height) = (700, 530);
    let rgb = ramp(width, height);
    for (code, affine) in [
        (32640, Affine([1.0, 0.0, 344_000.5, 0.0, -1.0, 2_790_000.5])),
        (4326, Affine([1e-5, 0.0, 55.3, 0.0, -9e-6, 25.2])),
        (32640, Affine([0.8, 0.3, 344_000.0, 0.3, -0.8, 2_790_000.0])),
    ] {
        let path = dir.path().join("map.tif");
        write_rgb(&path, &rgb, width, height, &affine, &Crs::from_epsg(code).unwrap()).unwrap();
        let map = GeoTiff::open(&path).unwrap();
        assert_eq!((map.size_px(), map.crs().epsg(), map.name()), ((700, 530), code, "map.tif"));
        for (a, b) in map.affine().0.iter().zip(affine.0) {
            assert!((a - b).abs() < 1e-9, "{:?} {affine:?}", map.affine());
        }
        assert_eq!(map.digest().unwrap().len(), 64);
        let (centre, m_per_px) = (map.centre().unwrap(), map.m_per_px());
        let window = MapCache::new(map, 1 << 22).window(&WindowSpec { centre, width_m: 40.0 * m_per_px, m_per_px }).unwrap();
        assert_eq!(window.valid_fraction(), 1.0);
        let at = |x: usize, y: usize| -> Vec<u8> { window.rgb[(y * 40 + x) * 3..][..3].to_vec() };
        let near = |a: Vec<u8>, b: [u8; 3]| a.iter().zip(b).all(|(&a, b)| a.abs_diff(b) <= 1);
        assert!(near(at(20, 20), [87, 66, 76]), "{:?}", at(20, 20));
    }
}

#[test]
fn rasterio_reads_what_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let path = dubai(dir.path(), 300, 200);
    let script = "import rasterio,sys,hashlib;d=rasterio.open(sys.argv[1]);import numpy as np;\
        print(d.width,d.height,d.count,d.crs.to_epsg(),*d.transform[:6],d.compression.name,hashlib.sha256(np.moveaxis(d.read(),0,-1).tobytes()).hexdigest())";
    let out = std::process::Command::new(oracle::python()).args(["-c", script]).arg(&path).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    use sha2::Digest;
    let digest: String = sha2::Sha256::digest(ramp(300, 200)).iter().map(|b| format!("{b:02x}")).collect();
    let expected = format!("300 200 3 32640 1.0 0.0 344000.0 0.0 -1.0 2790001.0 deflate {digest}");
    assert_eq!(String::from_utf8_lossy(&out.stdout).trim(), expected);
}

#[test]
fn an_offset_of_512_m_at_a_zone_edge_is_true_to_a_decimetre() {
    let dir = oracle::run("utm_edge.py", &[]);
    let mut cache = MapCache::new(GeoTiff::open(&dir.path().join("edge.tif")).unwrap(), 1 << 24);
    let table = std::fs::read_to_string(dir.path().join("edge.tsv")).unwrap();
    assert_eq!(table.lines().count(), 7);
    for line in table.lines() {
        let n: Vec<f64> = line.split('\t').map(|f| f.parse().unwrap()).collect();
        let (centre, target) = (LatLon::new(n[0], n[1]).unwrap(), LatLon::new(n[4], n[5]).unwrap());
        let window = cache.window(&WindowSpec { centre, width_m: 1537.0, m_per_px: 1.0 }).unwrap();
        let (x, y) = window.to_px(target);
        assert!((x - 768.0 - n[2]).hypot(y - 768.0 + n[3]) < 0.01, "{line}: {x} {y}");
        assert!(window.to_lat_lon(768.0 + n[2], 768.0 - n[3]).distance_m(target) < 0.01, "{line}");
        // And through the map: the affine of the map's own pixels, and the colour that stands there.
        let (cx, cy) = cache.map().crs().forward(window.to_lat_lon(768.0 + n[2], 768.0 - n[3])).unwrap();
        let (column, row) = cache.map().affine().inverse().unwrap().apply(cx, cy);
        assert!((column - n[6]).hypot(row - n[7]) < 0.1, "{line}: {column} {row}");
        let [a, b, c, d, e, f] = window.map_affine;
        let (ax, ay) = (a * x + b * y + c, d * x + e * y + f);
        assert!((ax - cx).hypot(ay - cy) < 0.1, "map_affine is {} m off", (ax - cx).hypot(ay - cy));
        let pixel = &window.rgb[(y.round() as usize * 1537 + x.round() as usize) * 3..][..3];
        let expected = [column / 8.0, row / 8.0, (column + row) / 16.0];
        assert!(pixel.iter().zip(expected).all(|(&p, e)| (f64::from(p) - e).abs() < 1.2), "{pixel:?} {expected:?}");
    }
}

#[test]
fn the_same_spec_is_the_same_window_and_the_last_three_stay() {
    let dir = tempfile::tempdir().unwrap();
    let map = GeoTiff::open(&dubai(dir.path(), 600, 600)).unwrap();
    let centre = map.centre().unwrap();
    let mut cache = MapCache::new(map, 1 << 20);
    let spec = |width_m| WindowSpec { centre, width_m, m_per_px: 1.0 };
    let first = cache.window(&spec(100.0)).unwrap();
    cache.window(&spec(200.0)).unwrap();
    cache.window(&spec(300.0)).unwrap();
    assert!(Arc::ptr_eq(&first, &cache.window(&spec(100.0)).unwrap()));
    cache.window(&spec(400.0)).unwrap();
    cache.window(&spec(500.0)).unwrap();
    cache.window(&spec(550.0)).unwrap();
    let again = cache.window(&spec(100.0)).unwrap();
    assert!(!Arc::ptr_eq(&first, &again));
    assert_eq!((&first.rgb, &first.valid), (&again.rgb, &again.valid), "the same window, whatever the cache held");
    for (width_m, m_per_px) in [(0.0, 1.0), (f64::NAN, 1.0), (100.0, 0.0), (100.0, -1.0), (1e9, 1.0), (1.0, 100.0)] {
        assert!(cache.window(&WindowSpec { centre, width_m, m_per_px }).is_err(), "{width_m} {m_per_px}");
    }
}

#[test]
fn windows_of_every_size_are_whole() {
    let dir = tempfile::tempdir().unwrap();
    let map = GeoTiff::open(&dubai(dir.path(), 700, 700)).unwrap();
    let centre = map.centre().unwrap();
    let mut cache = MapCache::new(map, 1 << 24);
    for size in (1..20).chain(120..140).chain(250..262).chain([384, 385, 512, 513, 600]) {
        for m_per_px in [1.0, 0.37] {
            let window = cache.window(&WindowSpec { centre, width_m: size as f64 * m_per_px, m_per_px }).unwrap();
            assert_eq!((window.size_px, window.valid_fraction()), (size, 1.0), "{m_per_px} m/px");
            assert_eq!((window.rgb.len(), window.valid.len()), (size * size * 3, size * size));
        }
    }
}

#[test]
fn a_disc_can_hold_a_footprint_only_where_the_map_is() {
    let dir = tempfile::tempdir().unwrap();
    let map = GeoTiff::open(&dubai(dir.path(), 1200, 1200)).unwrap();
    let centre = map.centre().unwrap();
    let mut cache = MapCache::new(map, 1 << 24);
    let mut holds =
        |east_m: f64, radius_m: f64| cache.can_hold(centre.offset(Enu { east_m, north_m: 0.0 }), radius_m, 512.0, 0.9).unwrap();
    assert!(holds(0.0, 512.0));
    assert!(holds(0.0, 0.0));
    // The map ends 600 m east; a footprint whose middle is 395 m out (344 + 10 % of 512) still has 90 % on it.
    assert!(holds(385.0, 0.0));
    assert!(!holds(405.0, 0.0));
    // A prior off the map is no reason while the disc reaches back.
    assert!(holds(800.0, 512.0));
    assert!(!holds(395.0 + 512.0 + 20.0, 512.0));
    assert!(!holds(50_000.0, 512.0));
    let guangzhou = LatLon::new(23.1, 113.3).unwrap();
    assert!(!cache.can_hold(guangzhou, 512.0, 512.0, 0.9).unwrap());
}

#[test]
fn a_window_on_another_continent_is_empty_not_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let mut cache = MapCache::new(GeoTiff::open(&dubai(dir.path(), 300, 300)).unwrap(), 1 << 20);
    for (lat, lon) in [(23.1, 113.3), (-33.0, -70.0), (89.99, 0.0), (-90.0, 0.0), (25.2, -124.7)] {
        let centre = LatLon::new(lat, lon).unwrap();
        let window = cache.window(&WindowSpec { centre, width_m: 1536.0, m_per_px: 6.0 }).unwrap();
        assert_eq!(window.valid_fraction(), 0.0, "{lat} {lon}");
        assert!(window.rgb.iter().all(|&v| v == 0));
    }
}

#[test]
fn fine_stripes_become_grey_not_moire() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("stripes.tif");
    let (width, height) = (1000, 1000);
    let rgb: Vec<u8> =
        (0..width * height).flat_map(|i| if (i % width + i / width) % 2 == 0 { [255; 3] } else { [0; 3] }).collect();
    let affine = Affine([0.25, 0.0, 344_000.0, 0.0, -0.25, 2_790_000.0]);
    write_rgb(&path, &rgb, width, height, &affine, &Crs::from_epsg(32640).unwrap()).unwrap();
    let map = GeoTiff::open(&path).unwrap();
    let centre = map.centre().unwrap();
    let mut cache = MapCache::new(map, 1 << 24);
    for m_per_px in [0.5, 0.6, 0.75, 1.0, 1.7, 3.0] {
        let window = cache.window(&WindowSpec { centre, width_m: 180.0, m_per_px }).unwrap();
        let (low, high) = window.rgb.iter().fold((255, 0), |(l, h), &v| (v.min(l), v.max(h)));
        assert!(low > 90 && high < 165, "{m_per_px} m/px: {low} to {high}");
    }
}

#[test]
fn real_maps_read_as_rasterio_reads_them() {
    let Some(shared) = oracle::shared() else {
        eprintln!("SKIPPED: no `shared` folder beside the checkout, so no real maps");
        return;
    };
    let maps = shared.join("data/maps");
    let dir = oracle::run("real_maps.py", &[maps.to_str().unwrap()]);
    let table = std::fs::read_to_string(dir.path().join("cases.tsv")).unwrap();
    assert!(table.lines().count() >= 5);
    for line in table.lines() {
        let f: Vec<&str> = line.split('\t').collect();
        let number = |i: usize| f[i].parse::<f64>().unwrap();
        let map = GeoTiff::open(&maps.join(f[1])).unwrap();
        let spec = WindowSpec { centre: LatLon::new(number(2), number(3)).unwrap(), width_m: number(4), m_per_px: number(5) };
        let window = MapCache::new(map, 1 << 24).window(&spec).unwrap();
        let expected = std::fs::read(dir.path().join(format!("{}.rgb", f[0]))).unwrap();
        let expected: Vec<f32> = expected.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        assert_eq!(window.rgb.len(), expected.len());
        let mut differences: Vec<f32> = window.rgb.iter().zip(&expected).map(|(&a, b)| (f32::from(a) - b).abs()).collect();
        differences.sort_by(f32::total_cmp);
        let mean = differences.iter().sum::<f32>() / differences.len() as f32;
        let (median, p99) = (differences[differences.len() / 2], differences[differences.len() * 99 / 100]);
        eprintln!("{}: median {median:.2}, mean {mean:.2}, p99 {p99:.1}, valid {:.3}", f[1], window.valid_fraction());
        assert!(median <= 0.6 && mean <= 0.8 && p99 <= 6.0, "{}: median {median}, mean {mean}, p99 {p99}", f[1]);
        assert!(window.valid_fraction() > 0.99, "{}: {}", f[1], window.valid_fraction());
    }
}

/// Peak resident memory of this process, bytes.
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 1024
}

const LARGE_MAP: &str = "NIGHTFIX_TEST_LARGE_MAP";

/// Runs in a process of its own, started by the test below: peak memory is a process's.
#[test]
fn memory_child() {
    let Some(path) = std::env::var_os(LARGE_MAP) else { return };
    let idle = peak_bytes();
    let map = GeoTiff::open(Path::new(&path)).unwrap();
    let centre = map.centre().unwrap();
    let window = MapCache::new(map, 32 << 20).window(&WindowSpec { centre, width_m: 1536.0, m_per_px: 1.0 }).unwrap();
    assert_eq!(window.valid_fraction(), 1.0);
    println!("peak over idle: {}", peak_bytes() - idle);
}

#[test]
fn a_window_of_a_20000_px_map_takes_under_100_mb() {
    for (tile, m_per_px) in [("256", "1.0"), ("1024", "1.0"), ("512", "0.3")] {
        let dir = oracle::run("large_map.py", &["20000", tile, m_per_px]);
        let child = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["memory_child", "--exact", "--nocapture", "--test-threads", "1"])
            .env(LARGE_MAP, dir.path().join("large.tif"))
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&child.stdout);
        let over: u64 = text
            .split("peak over idle: ")
            .nth(1)
            .and_then(|t| t.split_whitespace().next())
            .and_then(|t| t.parse().ok())
            .unwrap_or_else(|| panic!("{text}"));
        eprintln!("tiles of {tile} px, {m_per_px} m/px: {:.1} MB over idle", over as f64 / 1e6);
        assert!(over < 100_000_000, "{over} bytes");
    }
}
