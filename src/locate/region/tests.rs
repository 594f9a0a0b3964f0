use super::*;
use crate::geo::Enu;
use crate::locate::correlate::{Correlator, ShiftRange};
use crate::map::Window;
use crate::model::{Provider, Runtime};
use rand::{RngExt, SeedableRng};
use std::path::Path;

fn lite() -> Bundle {
    let runtime =
        Runtime::open(None, None, Provider::Cpu, 1).expect("`make build` puts ONNX Runtime beside the test executables");
    Bundle::open(&Path::new(env!("CARGO_MANIFEST_DIR")).join("models/bundles/lite-1536"), &runtime).unwrap()
}

/// Fields of colour with grain: structure at every size.
fn picture(side: usize) -> Vec<u8> {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let fields: Vec<[u8; 3]> = (0..64).map(|_| [0; 3].map(|_| rng.random_range(30..220))).collect();
    let field = |x: usize, y: usize| fields[(x / 37 + 5 * (y / 29) + (x * y / 4000)) % 64];
    (0..side * side).flat_map(|i| field(i % side, i / side).map(|v| v + rng.random_range(0..30u8))).collect()
}

fn crop(rgb: &[u8], side: usize, at: [usize; 2], size: usize) -> Vec<u8> {
    let rows = rgb.chunks_exact(side * 3).skip(at[1]).take(size);
    rows.flat_map(|row| row[at[0] * 3..(at[0] + size) * 3].to_vec()).collect()
}

#[test]
fn a_tile_inside_its_rim_is_a_part_of_the_whole() {
    let mut bundle = lite();
    let (side, core, at) = (640, 128, [224, 160]);
    let rgb = picture(side);
    let whole = encode(&mut bundle, &rgb, side).unwrap();
    let mut worst = |rim: usize| {
        let size = core + 2 * rim;
        let tile = encode(&mut bundle, &crop(&rgb, side, at.map(|v| v - rim), size), size).unwrap();
        let (cells, mut worst) = (side / 2, 0.0f32);
        for c in 0..tile.shape[1] {
            for y in 0..core / 2 {
                for x in 0..core / 2 {
                    let a = tile.data[(c * (size / 2) + y + rim / 2) * (size / 2) + x + rim / 2];
                    let b = whole.data[(c * cells + y + at[1] / 2) * cells + x + at[0] / 2];
                    worst = worst.max((a - b).abs());
                }
            }
        }
        worst
    };
    // Unit vectors: the largest value is about 1.
    assert!(worst(RIM_PX) < 1e-4, "with the rim: {}", worst(RIM_PX));
    assert!(worst(16) > 1e-2, "a narrow rim shows: {}", worst(16));
    assert!(features_belong_to_the_map(&mut bundle));
}

#[test]
fn the_blocks_logits_are_the_correlation() {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
    let mut random = |shape: [usize; 4]| Tensor {
        shape: shape.to_vec(),
        data: (0..shape.iter().product()).map(|_| rng.random_range(-1.0f32..1.0)).collect(),
    };
    for channels in [4, 3] {
        let (map, frame) = (random([1, channels, 44, 44]), random([1, channels, 8, 8]));
        let mut planner = FftPlanner::new();
        let fft = Transforms { n: 32, forward: planner.plan_fft_forward(32), inverse: planner.plan_fft_inverse(32) };
        let mut work = fft.work();
        let (tile, of_frame) = (fft.tile_spectra(&mut work, &map, 6), fft.spectra(&mut work, &frame.data, 8));
        let found = fft.correlate(&mut work, &of_frame, &tile, 24);
        let expected = Correlator::new(map).correlate(&frame, &ShiftRange { from: [6, 6], size: [24, 24] }).unwrap();
        assert_eq!(found.len(), expected.len());
        for (a, b) in found.iter().zip(&expected) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
    }
}

fn layout(block: usize) -> Layout {
    Layout { block, shifts: block - 48, cells: 48, stride: 2, frame_px: 96, m_per_px: 16.0 / 3.0 }
}

#[test]
fn tiles_cover_the_disc_once_and_touch() {
    let layout = layout(256);
    let home = LatLon { lat_deg: 25.2, lon_deg: 55.3 };
    let at = Enu { east_m: 3_210.0, north_m: -1_234.0 };
    let disc = Disc { centre: home.offset(at), radius_m: 5_000.0, vehicle_m: [0.0; 2] };
    let tiles = tiles_of(&layout, home, &disc).unwrap();
    let specs: Vec<WindowSpec> = tiles.iter().map(|tile| layout.spec(home, *tile)).collect();
    for i in 0..400 {
        let (angle, r) = (f64::from(i) * 2.4, 5_000.0 * (f64::from(i) / 399.0).sqrt());
        let place = disc.centre.offset(Enu { east_m: r * angle.sin(), north_m: r * angle.cos() });
        let owned = |spec: &WindowSpec| {
            let off = spec.centre.enu_to(place);
            let middle = (layout.tile_px() as f64 - 1.0) / 2.0;
            let shift = |m: f64| (middle + m / layout.m_per_px - layout.middle_px(0.0)) / layout.stride as f64;
            let [x, y] = [shift(off.east_m), shift(-off.north_m)];
            // A hair of tolerance: tiles are flat, the ellipsoid is not.
            let within = |v: f64, slack: f64| (-slack..layout.shifts as f64 + slack).contains(&v);
            (within(x, 0.2) && within(y, 0.2), within(x, -0.2) && within(y, -0.2))
        };
        let owners: Vec<_> = specs.iter().map(owned).collect();
        assert!(owners.iter().any(|o| o.0), "{i}: nobody's");
        assert!(owners.iter().filter(|o| o.1).count() <= 1, "{i}: more than one's");
    }
    let first = layout.spec(home, tiles[0]).centre.distance_m(disc.centre);
    assert!(first < layout.step_m() * 0.71, "the nearest first: {first}");
    let wide = Disc { radius_m: 1e6, ..disc };
    assert_eq!(tiles_of(&layout, home, &wide).unwrap_err().reason, Reason::PriorTooWide);
}

#[test]
fn only_places_with_enough_map_are_allowed() {
    let layout = layout(96);
    let side = layout.tile_px();
    let spec = WindowSpec { centre: LatLon { lat_deg: 0.0, lon_deg: 0.0 }, width_m: 1.0, m_per_px: 1.0 };
    // Map from the middle of the tile's image on, to the right.
    let valid: Vec<u8> = (0..side * side).map(|i| u8::from(i % side >= side / 2)).collect();
    let window = Window { spec, size_px: side, rgb: Vec::new(), valid, map_affine: [0.0; 6] };
    let allowed = layout.allowed(&window, 0.9);
    for (i, allowed) in allowed.iter().enumerate() {
        let left = RIM_PX + 2 * (i % layout.shifts);
        let seen = (left + 96).saturating_sub((side / 2).max(left)) as f64 / 96.0;
        assert_eq!(*allowed, seen >= 0.9, "{i}");
    }
    assert!(allowed.contains(&true) && allowed.contains(&false));
}

/// Milliseconds of this thread on a core.
fn core_ms() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    text.split(' ').next().unwrap().parse::<f64>().unwrap() / 1e6
}

/// How long 123 km2 take for one hypothesis, of spectra that are kept. To be run optimised:
/// `cargo test --lib a_hundred --config profile.dev.package.nightfix.opt-level=3 -- --ignored --nocapture`.
#[test]
#[ignore = "measures time: needs an optimised build"]
fn a_hundred_square_kilometres() {
    let layout = layout(BLOCK_CELLS);
    let (channels, n) = (32, layout.block);
    let mut planner = FftPlanner::new();
    let fft = Transforms { n, forward: planner.plan_fft_forward(n), inverse: planner.plan_fft_inverse(n) };
    let mut work = fft.work();
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
    let mut value = || rng.random_range(-1.0f32..1.0);
    let mut tile = || (0..channels / 2 * n * n).map(|_| Complex32::new(value(), value())).collect();
    let tiles: Vec<Vec<Complex32>> = (0..25).map(|_| tile()).collect();
    let frame: Vec<f32> = (0..channels * 48 * 48).map(|i| (i % 97) as f32 / 97.0 - 0.5).collect();
    let spec = WindowSpec { centre: LatLon { lat_deg: 0.0, lon_deg: 0.0 }, width_m: 1.0, m_per_px: 1.0 };
    let mut least_ms = f64::INFINITY;
    for _ in 0..5 {
        let begun = core_ms();
        let of_frame = fft.spectra(&mut work, &frame, 48);
        let transformed = core_ms();
        let mut planes = Vec::new();
        for (i, tile) in tiles.iter().enumerate() {
            let mut plane = Plane::new([i as i64 % 5, i as i64 / 5], spec, layout.shifts);
            plane.take(&fft.correlate(&mut work, &of_frame, tile, layout.shifts), 0, |_| true).unwrap();
            planes.push(plane);
        }
        let correlated = core_ms();
        let found = peaks(&planes, &layout, 3, 256.0, 2);
        let all = core_ms();
        let [frame_ms, tiles_ms, peaks_ms] = [transformed - begun, correlated - transformed, all - correlated];
        eprintln!("{:.1} km2: frame {frame_ms:.0} ms, tiles {tiles_ms:.0} ms, peaks {peaks_ms:.0} ms", found.searched_km2);
        assert!(found.searched_km2 > 100.0);
        least_ms = least_ms.min(all - begun);
    }
    assert!(least_ms < 300.0, "{least_ms} ms of one core");
}
