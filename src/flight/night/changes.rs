//! What differs between the day of the picture and the night of the flight, and what only the night shows.

use super::super::noise::{Dice, fbm};
use super::super::world::Cover;
use super::Scene;
use super::materials::Materials;

/// Warm walls: the rim of a standing building, inside and outside.
pub fn walls(celsius: &mut [f32], n: usize, standing: impl Fn(usize) -> bool, kelvin: f32) {
    let rim: Vec<usize> = (0..celsius.len())
        .filter(|&i| {
            let (x, here) = (i % n, standing(i));
            (x > 0 && standing(i - 1) != here) || (i >= n && standing(i - n) != here)
        })
        .collect();
    for i in rim {
        if let Some(t) = celsius.get_mut(i) {
            *t += kelvin;
        }
    }
}

/// Ground that is wetter, drier or freshly moved since the picture: about four patches per square kilometre.
pub fn patches(celsius: &mut [f32], scene: &Scene, dice: &mut Dice) {
    for _ in 0..count(scene, 4.0) {
        let (at, radius, kelvin, seed) = (place(scene, dice), dice.range32(10.0, 45.0), dice.normal32(0.0, 0.8), dice.seed());
        if cover(scene, at) == Some(Cover::Water as u8) {
            continue;
        }
        let warp = 1.0 / (0.8 * radius);
        dab(celsius, scene, at, radius * 1.5, |dx, dy, t| {
            let r = dx.hypot(dy) / (radius * (1.0 + 0.5 * fbm(dx * warp, dy * warp, 3, seed)));
            t + kelvin * ((1.0 - r) * 5.0).clamp(0.0, 1.0)
        });
    }
}

/// Buildings that the picture does not show: 4 % of those it shows and two per square kilometre.
pub fn new_buildings(celsius: &mut [f32], scene: &Scene, materials: &Materials, known: usize, dice: &mut Dice) {
    for _ in 0..count(scene, 2.0) + known / 25 {
        let (at, turn) = (place(scene, dice), dice.range32(0.0, 3.14));
        let (hu, hv, kelvin) = (dice.range32(3.0, 13.0), dice.range32(3.0, 9.0), dice.normal32(0.0, 2.0));
        if cover(scene, at) != Some(Cover::Bare as u8) {
            continue;
        }
        let (sin, cos) = turn.sin_cos();
        let roof = materials.of(Cover::Building as u8).celsius + kelvin;
        dab(celsius, scene, at, hu.hypot(hv) + 1.0, |dx, dy, t| {
            let d = ((cos * dx + sin * dy).abs() - hu).max((cos * dy - sin * dx).abs() - hv);
            t + (roof - t) * (0.5 - d / scene.m_per_px).clamp(0.0, 1.0)
        });
    }
}

/// Cars where they are tonight: warm engines, cold roofs.
pub fn vehicles(celsius: &mut [f32], scene: &Scene, dice: &mut Dice) {
    for _ in 0..count(scene, 1400.0) {
        let (at, turn) = (place(scene, dice), dice.range32(0.0, 3.14));
        if cover(scene, at) != Some(Cover::Road as u8) {
            continue;
        }
        let (sin, cos) = turn.sin_cos();
        let (roof, engine) = (dice.normal32(-2.0, 1.5), if dice.chance(0.5) { dice.range32(2.0, 9.0) } else { 0.0 });
        let half = if dice.chance(0.07) { 5.0 } else { 2.2 };
        dab(celsius, scene, at, half + 1.5, |dx, dy, t| {
            let (u, v) = (cos * dx + sin * dy, cos * dy - sin * dx);
            let inside = (0.5 - ((u.abs() - half).max(v.abs() - 1.0)) / scene.m_per_px).clamp(0.0, 1.0);
            t + inside * if u > half * 0.35 { engine } else { roof }
        });
    }
}

/// Animals, stones, machines: small warm or cold things.
pub fn clutter(celsius: &mut [f32], scene: &Scene, dice: &mut Dice) {
    for _ in 0..count(scene, 220.0) {
        let (at, radius, kelvin) = (place(scene, dice), dice.range32(0.5, 2.2), dice.normal32(0.3, 1.6));
        if cover(scene, at) == Some(Cover::Water as u8) {
            continue;
        }
        dab(celsius, scene, at, radius + 1.5, |dx, dy, t| {
            t + kelvin * (0.5 - (dx.hypot(dy) - radius) / scene.m_per_px).clamp(0.0, 1.0)
        });
    }
}

/// How many of something that comes `per_km2`.
fn count(scene: &Scene, per_km2: f64) -> usize {
    let side_km = scene.size_px as f64 * f64::from(scene.m_per_px) / 1000.0;
    (side_km * side_km * per_km2) as usize
}

/// A random place, metres.
fn place(scene: &Scene, dice: &mut Dice) -> [f32; 2] {
    let side = scene.size_px as f32 * scene.m_per_px;
    [dice.range32(0.0, side), dice.range32(0.0, side)]
}

fn cover(scene: &Scene, at: [f32; 2]) -> Option<u8> {
    let (x, y) = ((at[0] / scene.m_per_px) as usize, (at[1] / scene.m_per_px) as usize);
    scene.cover.get(y.min(scene.size_px - 1) * scene.size_px + x.min(scene.size_px - 1)).copied()
}

/// Changes the pixels within `reach_m` of a place: `f(dx, dy, old)` in metres from it.
fn dab(celsius: &mut [f32], scene: &Scene, at: [f32; 2], reach_m: f32, f: impl Fn(f32, f32, f32) -> f32) {
    let (n, mpp) = (scene.size_px, scene.m_per_px);
    let ends = |v: f32| (((v - reach_m) / mpp).max(0.0) as usize, (((v + reach_m) / mpp).ceil().max(0.0) as usize).min(n));
    let ((x0, x1), (y0, y1)) = (ends(at[0]), ends(at[1]));
    for y in y0..y1 {
        for x in x0..x1 {
            if let Some(t) = celsius.get_mut(y * n + x) {
                *t = f((x as f32 + 0.5) * mpp - at[0], (y as f32 + 0.5) * mpp - at[1], *t);
            }
        }
    }
}
