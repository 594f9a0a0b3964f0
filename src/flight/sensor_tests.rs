use super::*;
use crate::flight::night::NightField;

const SENSOR: Sensor = Sensor { width: 160, height: 128, hfov_deg: 69.2, noise: 0.0 };

fn view(yaw_deg: f64, pitch_deg: f64, roll_deg: f64) -> View {
    View { agl_m: 580.0, yaw_deg, pitch_deg, roll_deg }
}

/// Ground (east, north) of a frame pixel.
fn ground(view: &View, u: f64, v: f64) -> [f64; 2] {
    let [e, n, w] = SENSOR.ground_homography(view).map(|[a, b, c]| a * u + b * v + c);
    [e / w, n / w]
}

fn close(found: [f64; 2], expected: [f64; 2]) {
    let off = (found[0] - expected[0]).hypot(found[1] - expected[1]);
    assert!(off < 1e-6, "found {found:?}, expected {expected:?}");
}

#[test]
fn nadir_is_under_the_camera_and_up_points_along_yaw() {
    let gsd = SENSOR.gsd_m(580.0);
    let (cu, cv) = (79.5, 63.5);
    close(ground(&view(0.0, 0.0, 0.0), cu, cv), [0.0, 0.0]);
    close(ground(&view(0.0, 0.0, 0.0), cu + 1.0, cv), [gsd, 0.0]);
    close(ground(&view(0.0, 0.0, 0.0), cu, cv - 1.0), [0.0, gsd]);
    close(ground(&view(90.0, 0.0, 0.0), cu, cv - 1.0), [gsd, 0.0]);
    close(ground(&view(90.0, 0.0, 0.0), cu + 1.0, cv), [0.0, -gsd]);
}

#[test]
fn nose_up_looks_ahead_and_right_side_down_looks_left() {
    let reach = 580.0 * 5.0_f64.to_radians().tan();
    close(ground(&view(0.0, 5.0, 0.0), 79.5, 63.5), [0.0, reach]);
    close(ground(&view(90.0, 5.0, 0.0), 79.5, 63.5), [reach, 0.0]);
    close(ground(&view(0.0, 0.0, 5.0), 79.5, 63.5), [-reach, 0.0]);
}

#[test]
fn a_pixel_is_a_ray_that_meets_the_ground() {
    // The same by angles: at nadir a pixel 30 columns right of the axis looks atan(30 / f) to the right; rolled by
    // as much the other way it looks straight down.
    let focal = 80.0 / 34.6_f64.to_radians().tan();
    let tilt_deg = (30.0 / focal).atan().to_degrees();
    close(ground(&view(37.0, 0.0, tilt_deg), 79.5 + 30.0, 63.5), [0.0, 0.0]);
    close(ground(&view(37.0, tilt_deg, 0.0), 79.5, 63.5 + 30.0), [0.0, 0.0]);
}

#[test]
fn what_is_hot_on_the_ground_is_bright_where_the_homography_says() {
    // A warm spot 120 m east and 60 m north of the camera, on a field of 1 m pixels about it.
    let n = 1001;
    let mut celsius = vec![15.0_f32; n * n];
    for (i, t) in celsius.iter_mut().enumerate() {
        let (x, y) = ((i % n) as f32, (i / n) as f32);
        *t += 20.0 * (-((x - 620.0).powi(2) + (y - 440.0).powi(2)) / 200.0).exp();
    }
    let night = NightField { size_px: n, celsius };
    for (yaw, pitch, roll) in [(0.0, 0.0, 0.0), (33.0, 0.0, 0.0), (200.0, 3.0, -2.0)] {
        let view = view(yaw, pitch, roll);
        let mut dice = Dice::new(1, 1);
        let mut faults = Faults::draw(&SENSOR, &mut dice);
        faults.dead.clear();
        let axes = [[500.0, 500.0], [1.0, 0.0], [0.0, -1.0]];
        let counts = expose(&night, &SENSOR, &view, axes, [0.0, 0.0], &mut faults, &mut dice);
        assert!(counts.iter().all(|c| *c <= MAX_COUNT));
        // Half way up to the spot: what varies over the field itself stays below.
        let (low, high) = (counts.iter().min().expect("pixels"), counts.iter().max().expect("pixels"));
        let floor = (f64::from(*low) + f64::from(*high)) / 2.0;
        let (mut sum, mut u, mut v) = (0.0, 0.0, 0.0);
        for (i, c) in counts.iter().enumerate() {
            let weight = (f64::from(*c) - floor).max(0.0).powi(2);
            sum += weight;
            u += weight * (i % SENSOR.width) as f64;
            v += weight * (i / SENSOR.width) as f64;
        }
        let [east, north] = ground(&view, u / sum, v / sum);
        assert!((east - 120.0).hypot(north - 60.0) < 2.0, "yaw {yaw}: found {east:.1} {north:.1}");
    }
}

#[test]
fn noise_is_repeatable_and_changes_with_the_seed() {
    let night = NightField { size_px: 900, celsius: vec![17.0; 900 * 900] };
    let sensor = Sensor { noise: 1.0, ..SENSOR };
    let shoot = |seed| {
        let mut dice = Dice::new(seed, 1);
        let mut faults = Faults::draw(&sensor, &mut dice);
        let axes = [[450.0, 450.0], [1.0, 0.0], [0.0, -1.0]];
        expose(&night, &sensor, &view(10.0, 0.0, 0.0), axes, [0.0, 0.0], &mut faults, &mut dice)
    };
    assert_eq!(shoot(5), shoot(5));
    assert_ne!(shoot(5), shoot(6));
}
