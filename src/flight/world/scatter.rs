//! Small things: trees and groves, bushes, cars, boulders, pits, the sensor's grain.

use super::canvas::{Canvas, Cover, P, Rgb, Slab, distance};
use super::roads::{Kind, Road};
use super::terrain::Terrain;
use crate::flight::noise::{Dice, fbm, white};

/// A tree seen from above, with its shadow.
pub fn tree(canvas: &mut Canvas, at: P, radius_m: f32, sun: P, dice: &mut Dice) {
    let shadow = [at[0] - sun[0] * radius_m * 1.1, at[1] - sun[1] * radius_m * 1.1];
    let (x0, x1, y0, y1) = canvas.bounds(&[shadow], radius_m + 1.0);
    for y in y0..y1 {
        for x in x0..x1 {
            let dark = canvas.coverage(distance(canvas.middle(x, y), shadow) - radius_m);
            if dark > 0.0 {
                canvas.shade(y * canvas.width + x, 1.0 - 0.42 * dark);
            }
        }
    }
    let (seed, tone) = (dice.seed(), dice.range32(-14.0, 14.0));
    let colour: Rgb = [62.0 + tone, 84.0 + tone * 1.2, 44.0 + tone * 0.6];
    let mpp = canvas.mpp;
    canvas.paint(&[at], radius_m + 1.5, |p| {
        let (dx, dy) = (p[0] - at[0], p[1] - at[1]);
        let d = dx.hypot(dy) - radius_m * (1.0 + 0.2 * white((dx * 0.7) as i32, (dy * 0.7) as i32, seed));
        let light = 1.0
            + 0.28 * (dx * sun[0] + dy * sun[1]) / radius_m.max(0.5)
            + 0.12 * white((p[0] / 1.3) as i32, (p[1] / 1.3) as i32, seed);
        let cover = (radius_m > 1.6).then_some(Cover::Vegetation);
        Some((colour.map(|c| c * light), 0.95 * (0.5 - d / mpp).clamp(0.0, 1.0), cover))
    });
}

/// A car.
fn car(canvas: &mut Canvas, at: P, axis: P, dice: &mut Dice) {
    let body = Slab { centre: at, half_u: dice.range32(2.0, 2.6) * if dice.chance(0.08) { 2.4 } else { 1.0 }, half_v: 1.0, axis };
    let tones: [Rgb; 6] =
        [[235.0; 3], [190.0, 192.0, 196.0], [60.0, 60.0, 64.0], [120.0, 40.0, 36.0], [50.0, 70.0, 120.0], [28.0; 3]];
    let (colour, mpp) = (dice.pick(&tones, [200.0; 3]), canvas.mpp);
    canvas.paint(&body.corners(), 1.0, |p| Some((colour, 0.92 * (0.5 - body.signed(p) / mpp).clamp(0.0, 1.0), None)));
}

/// Cars on roads, at random places and never evenly spaced.
pub fn traffic(canvas: &mut Canvas, roads: &[Road], dice: &mut Dice) {
    for road in roads {
        let per_m = match road.kind {
            Kind::Highway => 1.0 / 55.0,
            Kind::Street => 1.0 / 90.0,
            Kind::Dirt => 1.0 / 700.0,
        };
        for pair in road.line.windows(2) {
            let &[a, b] = pair else { continue };
            let length = distance(a, b);
            if length > 0.1 && dice.chance(f64::from(length * per_m)) {
                let axis = [(b[0] - a[0]) / length, (b[1] - a[1]) / length];
                let off = dice.range32(0.25, 0.8) * road.half_m * if dice.chance(0.5) { 1.0 } else { -1.0 };
                car(canvas, [a[0] - axis[1] * off, a[1] + axis[0] * off], axis, dice);
            }
        }
    }
}

/// Trees in groves, along roads, in gardens; bushes in the steppe; boulders and pits in the desert.
pub fn plants(canvas: &mut Canvas, roads: &[Road], terrain: &Terrain, dice: &mut Dice) {
    let [w, h] = canvas.size_m();
    let area = f64::from(w * h) / 16e6;
    let (sun, grove) = (terrain.palette.sun, dice.seed());
    let open = |canvas: &Canvas, p: P| {
        canvas.cover_at(p).is_some_and(|c| c == Cover::Bare as u8 || c == Cover::Vegetation as u8) && terrain.shore_m(p) > 2.0
    };
    for _ in 0..(area * 210_000.0) as usize {
        let p = [dice.range32(0.0, w), dice.range32(0.0, h)];
        let wet = terrain.moisture.at(p[0], p[1]);
        let dense = fbm(p[0] / 150.0, p[1] / 150.0, 4, grove) + 0.35 * wet;
        let chance = if dense > 0.42 { 0.75 } else { 0.012 + 0.03 * wet };
        if dice.chance(f64::from(chance)) && open(canvas, p) {
            let radius = dice.range32(1.2, 3.2) + if dice.chance(0.2) { dice.range32(0.5, 2.8) } else { 0.0 };
            tree(canvas, p, radius, sun, dice);
        }
    }
    for road in roads.iter().filter(|r| r.kind != Kind::Dirt) {
        if !dice.chance(0.45) {
            continue;
        }
        let (gap, off) = (dice.range32(9.0, 24.0), road.half_m + dice.range32(2.5, 6.0));
        let mut next = 0.0;
        let mut along = 0.0;
        for pair in road.line.windows(2) {
            let &[a, b] = pair else { continue };
            let length = distance(a, b).max(0.1);
            along += length;
            if along < next {
                continue;
            }
            next = along + gap * dice.range32(0.5, 1.9);
            let normal = [-(b[1] - a[1]) / length, (b[0] - a[0]) / length];
            for side in [-off, off] {
                let p = [a[0] + normal[0] * side, a[1] + normal[1] * side];
                if dice.chance(0.7) && open(canvas, p) {
                    let radius = dice.range32(1.5, 3.6);
                    tree(canvas, p, radius, sun, dice);
                }
            }
        }
    }
    for _ in 0..(area * 26_000.0) as usize {
        let p = [dice.range32(0.0, w), dice.range32(0.0, h)];
        if !open(canvas, p) {
            continue;
        }
        let (radius, tone) =
            (dice.range32(0.6, 1.9), if dice.chance(0.7) { dice.range32(0.55, 0.85) } else { dice.range32(1.1, 1.25) });
        let (x0, x1, y0, y1) = canvas.bounds(&[p], radius + 1.0);
        for y in y0..y1 {
            for x in x0..x1 {
                let alpha = canvas.coverage(distance(canvas.middle(x, y), p) - radius);
                canvas.shade(y * canvas.width + x, 1.0 + (tone - 1.0) * alpha);
            }
        }
    }
    earthworks(canvas, terrain, dice);
}

/// Graded plots, heaps and pits: what building sites leave on bare ground.
fn earthworks(canvas: &mut Canvas, terrain: &Terrain, dice: &mut Dice) {
    let [w, h] = canvas.size_m();
    for _ in 0..(f64::from(w * h) / 16e6 * 210.0) as usize {
        let at = [dice.range32(0.0, w), dice.range32(0.0, h)];
        if canvas.cover_at(at) != Some(Cover::Bare as u8) || terrain.shore_m(at) < 40.0 {
            continue;
        }
        let (radius, seed, tone) = (dice.range32(9.0, 46.0), dice.seed(), dice.range32(0.72, 1.24));
        let (sx, sy) = (terrain.palette.sun[0], terrain.palette.sun[1]);
        let (relief, squeeze) = (dice.range32(-0.35, 0.35), dice.range32(0.5, 1.0));
        let (x0, x1, y0, y1) = canvas.bounds(&[at], radius * 1.7);
        for y in y0..y1 {
            for x in x0..x1 {
                let (p, index) = (canvas.middle(x, y), y * canvas.width + x);
                let (dx, dy) = (p[0] - at[0], (p[1] - at[1]) / squeeze);
                let r = dx.hypot(dy) / (radius * (1.0 + 0.45 * fbm(p[0] / 30.0, p[1] / 30.0, 3, seed)));
                if r < 1.0 && canvas.cover.get(index) == Some(&(Cover::Bare as u8)) {
                    let edge = ((1.0 - r) * 6.0).min(1.0);
                    let slope = relief * (dx * sx + dy * sy) / radius * if r > 0.6 { 1.6 } else { 0.4 };
                    canvas.shade(index, 1.0 + edge * (tone - 1.0 + slope + 0.08 * fbm(p[0] / 5.0, p[1] / 5.0, 2, seed)));
                }
            }
        }
    }
}

/// What the satellite's sensor adds: a little grain.
pub fn grain(canvas: &mut Canvas, amplitude: f32, dice: &mut Dice) {
    let seed = dice.seed();
    let width = canvas.width;
    for (index, pixel) in canvas.rgb.iter_mut().enumerate() {
        let n = amplitude * white((index % width) as i32, (index / width) as i32, seed);
        for v in pixel.iter_mut() {
            *v = (f32::from(*v) + n).round().clamp(0.0, 255.0) as u8;
        }
    }
}
