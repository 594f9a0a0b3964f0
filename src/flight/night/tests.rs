use super::raster::{blur, components, k_means, sample};
use super::*;
use crate::flight::world::{Cover, WorldOptions, make_world};

fn scene() -> Scene {
    let world = make_world(&WorldOptions { seed: 4, size_m: 1200.0, m_per_px: 4.0, grain: 0.0 });
    let valid = vec![1; world.classes.len()];
    Scene { size_px: world.size_px, m_per_px: 4.0, rgb: world.rgb, valid, cover: world.classes }
}

fn mean_of(scene: &Scene, night: &NightField, cover: Cover) -> f32 {
    let of = |c: &u8| *c == cover as u8;
    let count = scene.cover.iter().filter(|c| of(c)).count();
    assert!(count > 20, "{cover:?}: {count} px");
    night.celsius.iter().zip(&scene.cover).filter(|(_, c)| of(c)).map(|(t, _)| t).sum::<f32>() / count as f32
}

#[test]
fn a_night_is_repeatable_and_no_two_are_alike() {
    let scene = scene();
    let first = render(&scene, 1);
    assert_eq!(first.celsius, render(&scene, 1).celsius);
    assert_ne!(first.celsius, render(&scene, 2).celsius);
    assert!(first.celsius.iter().all(|t| t.is_finite() && (-20.0..60.0).contains(t)));
}

#[test]
fn roofs_are_cold_roads_warm_and_plants_turn_over() {
    let scene = scene();
    let nights: Vec<NightField> = (0..24).map(|seed| render(&scene, seed)).collect();
    let over = |a, b| nights.iter().filter(|n| mean_of(&scene, n, a) > mean_of(&scene, n, b)).count();
    assert!(over(Cover::Road, Cover::Building) >= 22);
    assert!(over(Cover::Water, Cover::Building) >= 22);
    let plants = over(Cover::Vegetation, Cover::Bare);
    assert!((3..=21).contains(&plants), "vegetation warmer than soil in {plants} of 24 nights");
}

#[test]
fn guessed_cover_knows_water_and_plants() {
    let paint = |rgb: [u8; 3]| guess_cover(&rgb.repeat(32 * 32), 32, 1.0);
    assert!(paint([20, 40, 45]).iter().all(|c| *c == Cover::Water as u8));
    assert!(paint([80, 130, 60]).iter().all(|c| *c == Cover::Vegetation as u8));
    assert!(paint([210, 190, 160]).iter().all(|c| *c == Cover::Bare as u8));
    assert!(paint([90, 90, 92]).iter().all(|c| *c == Cover::Road as u8));
}

#[test]
fn blur_keeps_a_constant_and_spreads_a_point_as_a_gaussian() {
    let mut flat = vec![3.0_f32; 20 * 30];
    blur(&mut flat, 20, 30, 2.5);
    assert!(flat.iter().all(|v| (v - 3.0).abs() < 1e-4));
    let mut point = vec![0.0_f32; 41 * 41];
    point[20 * 41 + 20] = 1.0;
    blur(&mut point, 41, 41, 2.0);
    let at = |dx: i32, dy: i32| point[((20 + dy) * 41 + 20 + dx) as usize];
    assert!((point.iter().sum::<f32>() - 1.0).abs() < 1e-4);
    // Ratio of a Gaussian at 2 px and 0 with sigma 2: exp(-1/2).
    for (dx, dy) in [(2, 0), (-2, 0), (0, 2), (0, -2)] {
        assert!((at(dx, dy) / at(0, 0) - (-0.5_f32).exp()).abs() < 1e-4);
    }
}

#[test]
fn components_count_groups_that_touch_along_a_side() {
    let mask = [1, 1, 0, 1, 0, 0, 0, 1, 1, 0, 1, 0_u8];
    let (labels, count) = components(|i| mask[i] == 1, 4, 3);
    assert_eq!(count, 4);
    assert_eq!(labels[0], labels[1]);
    assert_eq!(labels[3], labels[7]);
    assert_ne!(labels[7], labels[10]);
    assert!(labels.iter().zip(mask).all(|(l, m)| (*l > 0) == (m == 1)));
}

#[test]
fn k_means_finds_two_clouds() {
    let samples: Vec<[f32; 3]> =
        (0..100).map(|i| if i % 2 == 0 { [10.0, i as f32 / 50.0, 0.0] } else { [200.0, i as f32 / 50.0, 0.0] }).collect();
    let mut middles = k_means(&samples, vec![[0.0; 3], [50.0, 0.0, 0.0]], 8);
    middles.sort_by(|a, b| a[0].total_cmp(&b[0]));
    assert!((middles[0][0] - 10.0).abs() < 1e-3 && (middles[1][0] - 200.0).abs() < 1e-3);
}

#[test]
fn samples_are_bilinear_and_end_at_the_edge() {
    let image = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
    assert_eq!(sample(&image, 3, 2, 0.5, 0.5), Some(2.0));
    assert_eq!(sample(&image, 3, 2, 2.0, 1.0), Some(5.0));
    assert_eq!(sample(&image, 3, 2, 2.01, 1.0), None);
    assert_eq!(sample(&image, 3, 2, f32::NAN, 1.0), None);
}
