//! Farmland: an irregular patchwork of plots with rows, hedges and field tracks, and irrigated circles.

use super::canvas::{Canvas, Cover, P, Rgb, Slab, distance};
use super::terrain::Terrain;
use crate::flight::noise::{Dice, SlowField, fbm, lerp, smoothstep, value, white};

/// A plot, or a cut into two.
enum Plot {
    Cut { along_u: bool, at: f32, first: Box<Plot>, second: Box<Plot> },
    Crop(Crop),
}

/// What grows on a plot.
#[derive(Clone, Copy)]
struct Crop {
    colour: Rgb,
    cover: Option<Cover>,
    /// Direction across the rows.
    across: P,
    row_m: f32,
    contrast: f32,
    hedge: bool,
    track_m: f32,
    seed: u32,
    orchard_m: f32,
}

/// Paints farm blocks where the ground is green enough, and circles in the desert.
pub fn paint(canvas: &mut Canvas, dice: &mut Dice, terrain: &Terrain) {
    let [w, h] = canvas.size_m();
    let area = f64::from(w * h) / 16e6;
    let (bend, bend2) = (dice.seed(), dice.seed());
    let warp_x = SlowField::new(w, h, 12.0, |x, y| 34.0 * fbm(x / 310.0, y / 310.0, 3, bend));
    let warp_y = SlowField::new(w, h, 12.0, |x, y| 34.0 * fbm(x / 310.0, y / 310.0, 3, bend2));
    for _ in 0..(area * 34.0).ceil() as usize {
        let centre = [dice.range32(0.0, w), dice.range32(0.0, h)];
        let angle = dice.range32(0.0, 3.14);
        let block = Slab {
            centre,
            half_u: dice.range32(160.0, 420.0),
            half_v: dice.range32(130.0, 330.0),
            axis: [angle.cos(), angle.sin()],
        };
        let tree = cut(dice, [-block.half_u, block.half_u], [-block.half_v, block.half_v], block.axis, 0);
        if terrain.moisture.at(centre[0], centre[1]) < 0.35 && !dice.chance(0.12) {
            continue;
        }
        let ragged = dice.seed();
        let (x0, x1, y0, y1) = canvas.bounds(&block.corners(), 80.0);
        for y in y0..y1 {
            for x in x0..x1 {
                let p = canvas.middle(x, y);
                let q = [p[0] + warp_x.at(p[0], p[1]), p[1] + warp_y.at(p[0], p[1])];
                let edge = block.signed(q) + 14.0 * fbm(p[0] / 120.0, p[1] / 120.0, 2, ragged);
                if edge < 0.0 && terrain.shore_m(p) > 9.0 {
                    crop(canvas, y * canvas.width + x, p, block.local(q), &tree, &block);
                }
            }
        }
    }
    for _ in 0..(area * 7.0).ceil() as usize {
        circle(canvas, dice, terrain);
    }
}

/// Cuts a block in two, and again, until the plots are small enough.
fn cut(dice: &mut Dice, u: P, v: P, axis: P, depth: u32) -> Plot {
    let (lu, lv) = (u[1] - u[0], v[1] - v[0]);
    let limit = dice.range32(55.0, 190.0);
    if depth > 7 || lu.max(lv) < limit || lu.min(lv) < 30.0 {
        let along_u = dice.chance(if lu > lv { 0.2 } else { 0.8 });
        return Plot::Crop(sow(dice, if along_u { axis } else { [-axis[1], axis[0]] }));
    }
    let along_u = if (lu / lv).ln().abs() < 0.3 { dice.chance(0.5) } else { lu > lv };
    let ratio = dice.range32(0.27, 0.73);
    let at = if along_u { lerp(u[0], u[1], ratio) } else { lerp(v[0], v[1], ratio) };
    let (u1, u2, v1, v2) = if along_u { ([u[0], at], [at, u[1]], v, v) } else { (u, u, [v[0], at], [at, v[1]]) };
    Plot::Cut {
        along_u,
        at,
        first: Box::new(cut(dice, u1, v1, axis, depth + 1)),
        second: Box::new(cut(dice, u2, v2, axis, depth + 1)),
    }
}

/// Draws a crop.
fn sow(dice: &mut Dice, across: P) -> Crop {
    let kinds: [(Rgb, Option<Cover>); 8] = [
        ([78.0, 104.0, 48.0], Some(Cover::Vegetation)),
        ([104.0, 126.0, 62.0], Some(Cover::Vegetation)),
        ([62.0, 84.0, 46.0], Some(Cover::Vegetation)),
        ([134.0, 142.0, 84.0], Some(Cover::Vegetation)),
        ([186.0, 168.0, 118.0], Some(Cover::Bare)),
        ([150.0, 122.0, 90.0], Some(Cover::Bare)),
        ([118.0, 96.0, 74.0], Some(Cover::Bare)),
        ([204.0, 192.0, 150.0], Some(Cover::Bare)),
    ];
    let (colour, cover) = dice.pick(&kinds, ([150.0, 140.0, 100.0], None));
    let shift = dice.range32(-16.0, 16.0);
    Crop {
        colour: colour.map(|c| c + shift),
        cover,
        across,
        row_m: dice.range32(2.6, 9.0),
        contrast: dice.range32(0.01, 0.14),
        hedge: dice.chance(0.35),
        track_m: dice.range32(0.8, 2.6),
        seed: dice.seed(),
        orchard_m: if dice.chance(0.14) { dice.range32(6.5, 11.0) } else { 0.0 },
    }
}

/// Colours one pixel of a block.
fn crop(canvas: &mut Canvas, index: usize, p: P, local: P, tree: &Plot, block: &Slab) {
    let (mut plot, mut edge) = (tree, f32::MAX);
    let crop = loop {
        match plot {
            Plot::Crop(crop) => break crop,
            Plot::Cut { along_u, at, first, second } => {
                let d = if *along_u { local[0] - at } else { local[1] - at };
                edge = edge.min(d.abs());
                plot = if d < 0.0 { first } else { second };
            }
        }
    };
    edge = edge.min((block.half_u - local[0].abs()).min(block.half_v - local[1].abs()).abs());
    if edge < crop.track_m {
        let track = if crop.hedge { [58.0, 72.0, 40.0] } else { [188.0, 172.0, 138.0] };
        let cover = if crop.hedge { Cover::Vegetation } else { Cover::Bare };
        let patchy = if crop.hedge && value(p[0] / 7.0, p[1] / 7.0, crop.seed) < -0.3 { 0.15 } else { 0.85 };
        canvas.blend(index, track, patchy, Some(cover));
        return;
    }
    let across = p[0] * crop.across[0] + p[1] * crop.across[1];
    let along = p[1] * crop.across[0] - p[0] * crop.across[1];
    // Rows drift a little, and every row has its own vigour.
    let row = (across + 1.2 * value(along / 60.0, across / 200.0, crop.seed)) / crop.row_m;
    let vigour = white(row.floor() as i32, 0, crop.seed) * crop.contrast;
    let stripe = (std::f32::consts::TAU * row).sin() * crop.contrast;
    let soil = fbm(p[0] / 45.0, p[1] / 45.0, 3, crop.seed);
    let mut light = 1.0 + stripe + vigour + 0.16 * soil;
    let mut colour = crop.colour;
    if crop.orchard_m > 0.0 {
        // A tree per cell, jittered, some missing.
        let (cu, cv) = (across / crop.orchard_m, along / crop.orchard_m);
        let (iu, iv) = (cu.floor() as i32, cv.floor() as i32);
        let (ju, jv) = (0.5 + 0.22 * white(iu, iv, crop.seed), 0.5 + 0.22 * white(iv, iu, crop.seed ^ 1));
        let d = (cu - iu as f32 - ju).hypot(cv - iv as f32 - jv);
        let crown = 0.30 + 0.1 * white(iu, iv, crop.seed ^ 2);
        if white(iu, iv, crop.seed ^ 3) < 0.75 && d < crown {
            colour = [56.0, 76.0, 40.0];
            light = 1.0 + 0.3 * (crown - d);
        } else {
            colour = [168.0, 148.0, 112.0];
        }
    }
    canvas.blend(index, colour.map(|c| c * light), 0.94, crop.cover);
}

/// An irrigated circle with sectors at different stages.
fn circle(canvas: &mut Canvas, dice: &mut Dice, terrain: &Terrain) {
    let [w, h] = canvas.size_m();
    let centre = [dice.range32(0.0, w), dice.range32(0.0, h)];
    let radius = dice.range32(60.0, 175.0);
    let (start, ring, seed) = (dice.range32(0.0, 6.28), dice.range32(7.0, 16.0), dice.seed());
    let sectors: Vec<(f32, Rgb, Cover)> = (0..dice.below(4) + 1)
        .map(|_| {
            let green = dice.chance(0.65);
            let colour = if green { [76.0, 106.0, 52.0] } else { [176.0, 156.0, 112.0] };
            let shift = dice.range32(-14.0, 14.0);
            (dice.range32(0.5, 2.5), colour.map(|c| c + shift), if green { Cover::Vegetation } else { Cover::Bare })
        })
        .collect();
    let total: f32 = sectors.iter().map(|s| s.0).sum();
    let dry = terrain.moisture.at(centre[0], centre[1]) < 0.6;
    if !dry {
        return;
    }
    let fade = canvas.mpp;
    canvas.paint(&[centre], radius + 2.0, |p| {
        let r = distance(p, centre);
        let (alpha, angle) = ((0.5 - (r - radius) / fade).clamp(0.0, 1.0), (p[1] - centre[1]).atan2(p[0] - centre[0]));
        if alpha <= 0.0 || terrain.shore_m(p) < 5.0 {
            return None;
        }
        let mut share = (angle - start).rem_euclid(std::f32::consts::TAU) / std::f32::consts::TAU * total;
        let (_, colour, cover) = sectors.iter().find(|s| {
            share -= s.0;
            share < 0.0
        })?;
        let light = 1.0 + 0.05 * (r / ring * 6.28).sin() + 0.14 * fbm(p[0] / 40.0, p[1] / 40.0, 3, seed);
        let arm = smoothstep(2.0, 0.5, r);
        Some((colour.map(|c| lerp(c * light, 225.0, arm)), alpha * 0.95, Some(*cover)))
    });
}
