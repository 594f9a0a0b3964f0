//! Every allow-listed system against pyproj, and the refusals.

mod oracle;

use nightfix::geo::{Crs, LatLon};
use proptest::prelude::*;

/// One of every family, and every one that stands alone.
const CODES: [u32; 49] = [
    4326, 4258, 4269, 4490, 4674, 4167, 3857, 3395, 32601, 32617, 32633, 32640, 32660, 32701, 32723, 32736, 32756, 32760, 32661,
    32761, 5041, 5042, 25828, 25832, 25838, 3035, 3034, 26910, 26914, 26919, 26923, 31978, 31983, 31985, 2154, 2180, 2193, 5179,
    6372, 3031, 3413, 3976, 3995, 5070, 2263, 32631, 32649, 32719, 32652,
];

#[test]
fn every_allowed_system_agrees_with_proj_to_a_millimetre() {
    let codes = CODES.map(|c| c.to_string());
    let dir = oracle::run("crs_points.py", &codes.each_ref().map(String::as_str));
    let table = std::fs::read_to_string(dir.path().join("points.tsv")).unwrap();
    let mut seen = std::collections::BTreeMap::new();
    let mut worst = Vec::new();
    for line in table.lines() {
        let n: Vec<f64> = line.split('\t').map(|f| f.parse().unwrap()).collect();
        let (code, at) = (n[0] as u32, LatLon::new(n[1], n[2]).unwrap());
        let crs = Crs::from_epsg(code).unwrap();
        let (x, y) = crs.forward(at).unwrap();
        let unit_m = if crs.is_geographic() {
            111_000.0
        } else if code == 2263 {
            0.3048
        } else {
            1.0
        };
        let error_m = (x - n[3]).hypot(y - n[4]) * unit_m;
        let back_m = crs.inverse(n[3], n[4]).unwrap().distance_m(at);
        *seen.entry(code).or_insert(0) += 1;
        if error_m > 1e-3 || back_m > 1e-3 {
            worst.push(format!("EPSG:{code} at {at:?}: {error_m} m there, {back_m} m back"));
        }
    }
    assert!(worst.is_empty(), "{}", worst.join("\n"));
    for code in CODES {
        assert!(seen.get(&code).is_some_and(|&n| n >= 6), "EPSG:{code}: the oracle gave {:?} points", seen.get(&code));
    }
}

#[test]
fn systems_that_would_be_off_are_refused_with_the_reason() {
    for (code, word) in
        [(27700, "grid"), (28992, "grid"), (5514, "metre"), (2039, "metre"), (22770, "metre"), (32767, "user-defined")]
    {
        let text = Crs::from_epsg(code).unwrap_err().to_string();
        assert!(text.contains(&format!("EPSG:{code}")) && text.contains(word), "{text}");
    }
    for code in [0, 1, 4978, 4979, 9473, 27200, 32600, 32662, 65_536, 104_199, u32::MAX] {
        assert!(Crs::from_epsg(code).is_err(), "EPSG:{code}");
    }
}

#[test]
fn a_projection_half_a_world_from_home_is_an_error() {
    let dubai = Crs::from_epsg(32640).unwrap();
    let home = LatLon::new(25.2, 55.3).unwrap();
    assert!(dubai.forward_checked(home).is_ok());
    for (lat, lon) in [(25.2, -124.7), (23.1, 113.3 + 60.0), (-89.9, -120.0)] {
        let far = LatLon::new(lat, lon).unwrap();
        if let Ok((x, y)) = dubai.forward_checked(far) {
            assert!(dubai.inverse(x, y).unwrap().distance_m(far) < 1.0);
        }
    }
    let not_a_number = LatLon { lat_deg: f64::NAN, lon_deg: 1.0 };
    assert!(dubai.forward(not_a_number).is_err());
    assert!(dubai.inverse(f64::INFINITY, 0.0).is_err());
}

proptest! {
    #[test]
    fn no_coordinate_panics(code in prop::sample::select(CODES.to_vec()), x in any::<f64>(), y in any::<f64>(), lat in -91.0..91.0, lon in -400.0..400.0) {
        let crs = Crs::from_epsg(code).unwrap();
        if let Ok(at) = crs.inverse(x, y) {
            prop_assert!(LatLon::new(at.lat_deg, at.lon_deg).is_some());
        }
        if let Ok((x, y)) = crs.forward(LatLon { lat_deg: lat, lon_deg: lon }) {
            prop_assert!(x.is_finite() && y.is_finite());
        }
    }
}
