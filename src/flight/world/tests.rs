use super::*;

fn small(seed: u64) -> World {
    make_world(&WorldOptions { seed, size_m: 1500.0, m_per_px: 4.0, grain: 2.0 })
}

#[test]
fn the_same_seed_gives_the_same_world_and_another_another() {
    let (a, b) = (small(3), small(3));
    assert!(a.rgb == b.rgb && a.classes == b.classes);
    assert!(a.rgb != small(4).rgb);
    assert_eq!((a.size_px, a.rgb.len(), a.classes.len()), (375, 375 * 375 * 3, 375 * 375));
}

#[test]
fn every_kind_of_cover_occurs_and_no_pixel_is_bare_of_one() {
    for seed in 1..=5 {
        let world = small(seed);
        let share =
            |cover: Cover| world.classes.iter().filter(|c| **c == cover as u8).count() as f64 / world.classes.len() as f64;
        assert_eq!(share(Cover::Unlabelled), 0.0);
        for (cover, least) in
            [(Cover::Building, 0.001), (Cover::Bare, 0.1), (Cover::Road, 0.01), (Cover::Vegetation, 0.005), (Cover::Water, 0.005)]
        {
            assert!(share(cover) > least, "seed {seed}: {cover:?} {}", share(cover));
        }
        assert!(world.classes.iter().all(|c| *c <= 5));
    }
}

#[test]
fn no_lattice_repeats() {
    // The luminance, its local mean removed, correlated with itself 40 to 600 m away along both axes: a repeating pattern
    // would come near 1.
    let world = small(2);
    let n = world.size_px;
    let luma: Vec<f64> = world.rgb.chunks_exact(3).map(|p| p.iter().map(|v| f64::from(*v)).sum::<f64>()).collect();
    let mean = luma.iter().sum::<f64>() / luma.len() as f64;
    let at = |x: usize, y: usize| luma[y * n + x] - mean;
    let correlation = |dx: usize, dy: usize| {
        let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
        for y in 0..n - dy {
            for x in 0..n - dx {
                let (a, b) = (at(x, y), at(x + dx, y + dy));
                (ab, aa, bb) = (ab + a * b, aa + a * a, bb + b * b);
            }
        }
        ab / (aa * bb).sqrt()
    };
    for lag in 10..150 {
        for (dx, dy) in [(lag, 0), (0, lag)] {
            let found = correlation(dx, dy);
            assert!(found < 0.6, "lag {dx}, {dy}: {found}");
        }
    }
}
