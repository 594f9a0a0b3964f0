//! Rendered by an independent pinhole (axis by axis, ray by ray), rectified, compared with the ground that was rendered.

use super::*;
use proptest::prelude::*;

const WIDTH: u32 = 320;
const HEIGHT: u32 = 256;
const AGL_M: f64 = 400.0;
const HFOV_DEG: f64 = 40.0;

/// Grey value of the ground, east and north of the vehicle in metres: smooth, without symmetry.
fn ground(east_m: f64, north_m: f64) -> f64 {
    128.0 + 60.0 * (east_m / 31.0 + 0.7).sin() * (north_m / 37.0).cos() + 50.0 * ((east_m - 2.0 * north_m) / 90.0).sin()
}

/// Ground point seen by a ray that starts as (forward, right, down) in the camera's axes: turned by roll about forward, by
/// pitch about right, by yaw about down, then followed to the ground.
fn ground_point(ray: [f64; 3], pose: &Pose) -> (f64, f64) {
    let angle = |deg: Option<f64>| deg.unwrap_or(0.0).to_radians().sin_cos();
    let [forward, right, down] = ray;
    let (s, c) = angle(pose.roll_deg);
    // Right side down: what was right gains depth, what was down moves left.
    let (right, down) = (right * c - down * s, right * s + down * c);
    let (s, c) = angle(pose.pitch_deg);
    // Nose up: what was down swings forward.
    let (forward, down) = (forward * c + down * s, down * c - forward * s);
    let (s, c) = angle(pose.yaw_deg);
    let (north, east) = (forward * c - right * s, forward * s + right * c);
    let height = pose.agl_m.unwrap_or(AGL_M);
    (height * east / down, height * north / down)
}

fn render(pose: &Pose) -> GrayFrame {
    let focal_px = f64::from(WIDTH) / 2.0 / (HFOV_DEG.to_radians() / 2.0).tan();
    let pixel = |i: u32| {
        let (u, v) =
            (f64::from(i % WIDTH) - (f64::from(WIDTH) - 1.0) / 2.0, f64::from(i / WIDTH) - (f64::from(HEIGHT) - 1.0) / 2.0);
        let (east_m, north_m) = ground_point([-v, u, focal_px], pose);
        ground(east_m, north_m).round() as u8
    };
    GrayFrame { width: WIDTH, height: HEIGHT, pixels: (0..WIDTH * HEIGHT).map(pixel).collect() }
}

fn pose(yaw_deg: f64, pitch_deg: f64, roll_deg: f64) -> Pose {
    Pose {
        agl_m: Some(AGL_M),
        hfov_deg: Some(HFOV_DEG),
        gsd_m: None,
        yaw_deg: Some(yaw_deg),
        pitch_deg: Some(pitch_deg),
        roll_deg: Some(roll_deg),
    }
}

/// Largest difference between the rectified square and the ground about `vehicle_px`.
fn worst_difference(square: &Rectified) -> f64 {
    let n = square.size_px;
    let differences = (0..n * n).filter(|&i| square.valid[i] == 1).map(|i| {
        let east_m = ((i % n) as f64 - square.vehicle_px.0) * square.m_per_px;
        let north_m = (square.vehicle_px.1 - (i / n) as f64) * square.m_per_px;
        (f64::from(square.pixels[i]) - ground(east_m, north_m)).abs()
    });
    differences.fold(0.0, f64::max)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn any_attitude_gives_the_ground_back(yaw_deg in -180.0_f64..360.0, pitch_deg in -25.0_f64..25.0, roll_deg in -25.0_f64..25.0) {
        let pose = pose(yaw_deg, pitch_deg, roll_deg);
        let square = rectify(&render(&pose), &pose, 200, 1.0)?;
        prop_assert!(square.valid_fraction() > 0.9, "{}", square.valid_fraction());
        prop_assert!(worst_difference(&square) < 3.0, "{} {:?}", worst_difference(&square), square.vehicle_px);
    }

    /// Any numbers, any size of frame: an error or a square, never a panic.
    #[test]
    fn any_numbers_never_panic(
        values in prop::array::uniform6(any::<Option<f64>>()),
        tame in prop::array::uniform6(-60.0_f64..60.0),
        choose in any::<u8>(),
        size in (0_u32..9, 0_u32..9),
        side in 0_usize..40,
        m_per_px in any::<f64>(),
    ) {
        let pick = |i: usize| if choose >> i & 1 == 1 { values[i] } else { Some(tame[i]) };
        let pose = Pose { agl_m: pick(0), gsd_m: pick(1), hfov_deg: pick(2), yaw_deg: pick(3), pitch_deg: pick(4), roll_deg: pick(5) };
        let frame = GrayFrame { width: size.0, height: size.1, pixels: vec![9; (size.0 * size.1) as usize] };
        for m_per_px in [1.0, m_per_px] {
            if let Ok(square) = rectify(&frame, &pose, side, m_per_px) {
                prop_assert_eq!(square.pixels.len(), side * side);
                prop_assert!(square.vehicle_px.0.is_finite() && square.vehicle_px.1.is_finite());
            }
        }
    }
}

#[test]
fn signs_in_words() -> Result<(), FrameError> {
    let frame = GrayFrame { width: 64, height: 64, pixels: vec![100; 64 * 64] };
    let at = |yaw_deg, pitch_deg, roll_deg| rectify(&frame, &pose(yaw_deg, pitch_deg, roll_deg), 101, 2.0).map(|s| s.vehicle_px);
    let shift_px = AGL_M * 10.0_f64.to_radians().tan() / 2.0;
    for (angles, expected, why) in [
        ((0.0, 0.0, 0.0), (50.0, 50.0), "level: under the camera"),
        ((0.0, 10.0, 0.0), (50.0, 50.0 + shift_px), "nose up, heading north: looks ahead, the vehicle is south"),
        ((0.0, 0.0, 10.0), (50.0 + shift_px, 50.0), "right side down: looks left, the vehicle is east"),
        ((90.0, 10.0, 0.0), (50.0 - shift_px, 50.0), "nose up, heading east: the vehicle is west"),
        ((90.0, 0.0, 10.0), (50.0, 50.0 + shift_px), "right side down, heading east: looks north, the vehicle is south"),
        ((180.0, -10.0, 0.0), (50.0, 50.0 + shift_px), "nose down, heading south: looks back north, the vehicle is south"),
    ] {
        let found = at(angles.0, angles.1, angles.2)?;
        assert!((found.0 - expected.0).hypot(found.1 - expected.1) < 1e-9, "{why}: {found:?}, expected {expected:?}");
    }
    Ok(())
}

#[test]
fn one_to_one_is_the_frame_itself_turned_by_yaw() -> Result<(), FrameError> {
    let n = 64_usize;
    let frame = GrayFrame { width: 64, height: 64, pixels: (0..64 * 64).map(|i| (i * 37 % 251) as u8).collect() };
    let at = |u: usize, v: usize| frame.pixels[v * n + u];
    // Image up is where the yaw points: 90 degrees, image up = east, image right = south.
    let turns: [(f64, &dyn Fn(usize, usize) -> u8); 4] = [
        (0.0, &|x, y| at(x, y)),
        (90.0, &|x, y| at(y, n - 1 - x)),
        (180.0, &|x, y| at(n - 1 - x, n - 1 - y)),
        (270.0, &|x, y| at(n - 1 - y, x)),
    ];
    for (yaw_deg, expected) in turns {
        let pose = Pose { gsd_m: Some(1.0), yaw_deg: Some(yaw_deg), ..Pose::default() };
        let square = rectify(&frame, &pose, n, 1.0)?;
        assert!(square.valid.iter().all(|&v| v == 1), "{yaw_deg}");
        assert!((0..n * n).all(|i| square.pixels[i] == expected(i % n, i / n)), "{yaw_deg}");
        assert_eq!(square.agl_m, None);
    }
    Ok(())
}

#[test]
fn fine_frames_are_averaged_and_not_aliased() -> Result<(), FrameError> {
    // A checkerboard of single pixels at 0.167 m: grey at 1 m.
    let pixels = (0..640 * 512).map(|i| if (i % 640 + i / 640) % 2 == 0 { 0 } else { 200 }).collect();
    let frame = GrayFrame { width: 640, height: 512, pixels };
    let pose = Pose { gsd_m: Some(0.167), hfov_deg: Some(48.0), yaw_deg: Some(33.0), ..Pose::default() };
    let square = rectify(&frame, &pose, 128, 1.0)?;
    let worst = square.pixels.iter().zip(&square.valid).filter(|(_, valid)| **valid == 1).map(|(p, _)| p.abs_diff(100)).max();
    assert!(worst <= Some(1), "{worst:?}");
    let covered_m2 = square.valid.iter().map(|&v| f64::from(v)).sum::<f64>();
    let footprint_m2 = 640.0 * 512.0 * 0.167 * 0.167;
    assert!((covered_m2 / footprint_m2 - 1.0).abs() < 0.03, "{covered_m2} of {footprint_m2}");
    // The height follows from gsd and field of view.
    assert!(square.agl_m.is_some_and(|agl_m| (agl_m - 120.03).abs() < 0.01), "{:?}", square.agl_m);
    Ok(())
}

#[test]
fn averaging_keeps_the_place() -> Result<(), FrameError> {
    for (agl_m, side, m_per_px) in [(400.0, 60, 3.0), (400.0, 45, 4.1), (1500.0, 400, 1.0)] {
        let pose = Pose { agl_m: Some(agl_m), ..pose(20.0, 5.0, -8.0) };
        let square = rectify(&render(&pose), &pose, side, m_per_px)?;
        assert!(worst_difference(&square) < 6.0, "{agl_m} {m_per_px}: {}", worst_difference(&square));
    }
    Ok(())
}

#[test]
fn gsd_and_height_with_field_of_view_say_the_same() -> Result<(), FrameError> {
    let stated = pose(75.0, 12.0, -4.0);
    let frame = render(&stated);
    let gsd_m = 2.0 * AGL_M * (HFOV_DEG.to_radians() / 2.0).tan() / f64::from(WIDTH);
    let reference = rectify(&frame, &stated, 100, 1.5)?;
    for other in [
        Pose { gsd_m: Some(gsd_m), hfov_deg: None, ..stated },
        Pose { gsd_m: Some(gsd_m), agl_m: None, ..stated },
        Pose { gsd_m: Some(gsd_m), ..stated },
    ] {
        let square = rectify(&frame, &other, 100, 1.5)?;
        assert!(square.pixels.iter().zip(&reference.pixels).all(|(a, b)| a.abs_diff(*b) <= 1), "{other:?}");
        assert!((square.vehicle_px.0 - reference.vehicle_px.0).abs() < 1e-6);
    }
    Ok(())
}

#[test]
fn missing_or_impossible_numbers_name_the_field() {
    let frame = GrayFrame { width: 8, height: 8, pixels: vec![0; 64] };
    let level = Pose { gsd_m: Some(1.0), yaw_deg: Some(0.0), ..Pose::default() };
    let cases = [
        ("yaw_deg", Pose { yaw_deg: None, ..level }),
        ("gsd_m", Pose { gsd_m: None, ..level }),
        ("gsd_m", Pose { gsd_m: None, agl_m: Some(100.0), ..level }),
        ("gsd_m", Pose { gsd_m: None, hfov_deg: Some(40.0), ..level }),
        ("gsd_m", Pose { gsd_m: Some(0.0), ..level }),
        ("gsd_m", Pose { gsd_m: Some(-1.0), ..level }),
        ("gsd_m", Pose { gsd_m: Some(f64::NAN), ..level }),
        ("agl_m", Pose { agl_m: Some(f64::INFINITY), ..level }),
        ("hfov_deg", Pose { hfov_deg: Some(180.0), ..level }),
        ("yaw_deg", Pose { yaw_deg: Some(f64::NAN), ..level }),
        ("pitch_deg, roll_deg", Pose { pitch_deg: Some(46.0), hfov_deg: Some(40.0), ..level }),
        ("pitch_deg, roll_deg", Pose { pitch_deg: Some(33.0), roll_deg: Some(-33.0), hfov_deg: Some(40.0), ..level }),
        ("pitch_deg, roll_deg", Pose { roll_deg: Some(180.0), hfov_deg: Some(40.0), ..level }),
        ("hfov_deg", Pose { pitch_deg: Some(3.0), ..level }),
    ];
    for (expected, pose) in cases {
        let found = match rectify(&frame, &pose, 16, 1.0) {
            Err(FrameError::Field { field, .. }) => field,
            other => {
                assert!(other.is_err(), "{pose:?}");
                "another error"
            }
        };
        assert_eq!(found, expected, "{pose:?}");
    }
    let torn = GrayFrame { width: 8, height: 9, pixels: vec![0; 64] };
    assert!(rectify(&torn, &level, 16, 1.0).is_err());
    assert!(rectify(&frame, &level, 0, 1.0).is_err() && rectify(&frame, &level, 16, 0.0).is_err());
}
