//! Settlements: streets that grow from a main street, houses along them with many kinds of roofs, works and sheds.

use super::canvas::{Canvas, Cover, P, Rgb, Slab, distance, smooth};
use super::roads::{Kind, Road, Taken};
use super::terrain::Terrain;
use crate::flight::noise::{Dice, fbm, value, white};

/// A settlement to be.
#[derive(Debug, Clone, Copy)]
pub struct Site {
    /// Middle.
    pub at: P,
    /// How far it reaches, metres.
    pub radius_m: f32,
    /// Whether sheds and yards stand there instead of houses.
    pub works: bool,
}

/// Draws sites, away from water and from each other.
pub fn sites(size_m: P, terrain: &Terrain, dice: &mut Dice) -> Vec<Site> {
    let wanted = (f64::from(size_m[0] * size_m[1]) / 16e6 * dice.range(13.0, 19.0)).ceil() as usize;
    let mut out: Vec<Site> = Vec::new();
    for _ in 0..wanted * 30 {
        if out.len() >= wanted {
            break;
        }
        let site = Site {
            at: [dice.range32(0.03, 0.97) * size_m[0], dice.range32(0.03, 0.97) * size_m[1]],
            radius_m: dice.range32(110.0, 430.0),
            works: dice.chance(0.28),
        };
        let apart = out.iter().all(|o| distance(o.at, site.at) > 0.75 * (o.radius_m + site.radius_m));
        if apart && terrain.shore_m(site.at) > 30.0 {
            out.push(site);
        }
    }
    out
}

/// Grows the streets of a site: a main street, side streets off it, lanes off those.
pub fn streets(site: &Site, terrain: &Terrain, taken: &mut Taken, dice: &mut Dice) -> Vec<Road> {
    let mut roads: Vec<Road> = Vec::new();
    let heading = dice.range32(0.0, 6.28);
    let gap = if site.works { 1.8 } else { 1.0 };
    let mut queue = vec![(site.at, heading, 0_u32), (site.at, heading + 3.14, 0)];
    while let Some((start, heading, level)) = queue.pop() {
        if roads.len() > 140 {
            break;
        }
        let reach = match level {
            0 => site.radius_m,
            1 => site.radius_m * dice.range32(0.45, 0.95),
            _ => dice.range32(60.0, 190.0) * gap,
        };
        let (mut at, mut heading, bend) = (start, heading, dice.normal32(0.0, 0.0022));
        let mut line = vec![at];
        let mut along = 0.0;
        let (mut next, clear) = (dice.range32(30.0, 70.0) * gap, 26.0);
        while along < reach {
            heading += bend * 8.0 + dice.normal32(0.0, 0.012);
            let ahead = [at[0] + 8.0 * heading.cos(), at[1] + 8.0 * heading.sin()];
            let look = [at[0] + clear * heading.cos(), at[1] + clear * heading.sin()];
            let blocked = (along > 20.0 && taken.at(ahead))
                || terrain.shore_m(look) < 10.0
                || distance(ahead, site.at) > site.radius_m * 1.15;
            if blocked {
                if along > 20.0 && taken.at(ahead) {
                    line.push(ahead);
                }
                break;
            }
            at = ahead;
            along += 8.0;
            line.push(at);
            if along >= next && level < 2 {
                let turn = 1.57 + dice.normal32(0.0, 0.12);
                for side in [-1.0, 1.0] {
                    if dice.chance(if level == 0 { 0.85 } else { 0.6 }) {
                        queue.push((at, heading + side * turn, level + 1));
                    }
                }
                next += dice.range32(48.0, 125.0) * gap;
            }
        }
        if line.len() > 5 {
            let half_m = [dice.range32(3.8, 6.0), dice.range32(2.8, 4.2), dice.range32(2.2, 3.2)]
                .get(level as usize)
                .copied()
                .unwrap_or(2.5);
            let kind = if level == 2 && dice.chance(0.3) { Kind::Dirt } else { Kind::Street };
            let line = smooth(&line, 4.0);
            // The first metres stay free, so that the branch does not block the street it leaves.
            taken.take_line(line.get(5..).unwrap_or(&[]), half_m + 1.5);
            roads.push(Road { line, half_m, kind });
        }
    }
    roads
}

/// Lines both sides of a street with houses or sheds.
pub fn build(canvas: &mut Canvas, road: &Road, works: bool, density: f32, terrain: &Terrain, taken: &mut Taken, dice: &mut Dice) {
    for side in [-1.0_f32, 1.0] {
        let mut along = dice.range32(4.0, 30.0);
        let mut travelled = 0.0;
        for pair in road.line.windows(2) {
            let &[a, b] = pair else { continue };
            let length = distance(a, b).max(1e-3);
            travelled += length;
            if travelled < along {
                continue;
            }
            let axis = [(b[0] - a[0]) / length, (b[1] - a[1]) / length];
            let (front, depth) = if works {
                (dice.range32(16.0, 60.0), dice.range32(14.0, 42.0))
            } else {
                (dice.range32(8.0, 22.0), dice.range32(8.0, 17.0))
            };
            let setback = if works { dice.range32(6.0, 20.0) } else { dice.range32(2.5, 11.0) };
            let off = side * (road.half_m + setback + depth / 2.0);
            let centre = [b[0] - axis[1] * off, b[1] + axis[0] * off];
            let house = Slab { centre, half_u: front / 2.0, half_v: depth / 2.0, axis };
            along = travelled + front + if works { dice.range32(6.0, 30.0) } else { dice.range32(3.0, 16.0) };
            if dice.chance(f64::from(1.0 - density)) || !free(&house, taken) || terrain.shore_m(centre) < 14.0 {
                continue;
            }
            plot(canvas, &house, works, dice);
            raise(canvas, &house, works, terrain.palette.sun, dice);
            occupy(&house, taken);
        }
    }
}

/// Whether nothing stands there yet.
fn free(house: &Slab, taken: &Taken) -> bool {
    let (nu, nv) = ((house.half_u / 2.0).ceil() as i32, (house.half_v / 2.0).ceil() as i32);
    (-nu..=nu).all(|i| {
        (-nv..=nv).all(|j| {
            let (u, v) = (i as f32 / nu as f32 * (house.half_u + 1.5), j as f32 / nv as f32 * (house.half_v + 1.5));
            !taken.at(house.place(u, v))
        })
    })
}

/// Takes the ground of a building.
fn occupy(house: &Slab, taken: &mut Taken) {
    let (nu, nv) = ((house.half_u / 2.0).ceil() as i32, (house.half_v / 2.0).ceil() as i32);
    for i in -nu..=nu {
        for j in -nv..=nv {
            taken.take(house.place(i as f32 / nu as f32 * house.half_u, j as f32 / nv as f32 * house.half_v), 2.0);
        }
    }
}

/// The yard: paving, lawn or a wall round it.
fn plot(canvas: &mut Canvas, house: &Slab, works: bool, dice: &mut Dice) {
    let yard = house.grown(dice.range32(2.0, if works { 9.0 } else { 5.5 }));
    let (colour, cover): (Rgb, Cover) = match dice.below(if works { 2 } else { 4 }) {
        0 => ([176.0, 170.0, 160.0], Cover::Bare),
        1 => ([150.0, 140.0, 122.0], Cover::Bare),
        2 => ([98.0, 118.0, 70.0], Cover::Vegetation),
        _ => ([204.0, 192.0, 168.0], Cover::Bare),
    };
    let (seed, wall) = (dice.seed(), dice.chance(0.4));
    let mpp = canvas.mpp;
    canvas.paint(&yard.corners(), 1.0, |p| {
        let d = yard.signed(p);
        let rim = if wall && d > -1.1 { 1.3 } else { 1.0 };
        let light = rim * (1.0 + 0.12 * fbm(p[0] / 6.0, p[1] / 6.0, 2, seed));
        Some((colour.map(|c| c * light), 0.8 * (0.5 - d / mpp).clamp(0.0, 1.0), Some(cover)))
    });
    if !works && dice.chance(0.06) {
        let pool =
            Slab { centre: house.place(0.0, house.half_v + 3.2), half_u: dice.range32(2.5, 5.0), half_v: 1.7, axis: house.axis };
        canvas.paint(&pool.corners(), 1.0, |p| {
            Some(([88.0, 170.0, 190.0], (0.5 - pool.signed(p) / mpp).clamp(0.0, 1.0), Some(Cover::Water)))
        });
    }
}

/// A building: shadow, roof by kind, parapet, clutter.
pub fn raise(canvas: &mut Canvas, house: &Slab, works: bool, sun: P, dice: &mut Dice) {
    let height = if works { dice.range32(5.0, 11.0) } else { dice.range32(3.0, 9.0) * if dice.chance(0.08) { 3.0 } else { 1.0 } };
    let mpp = canvas.mpp;
    let throw = [-sun[0] * height * 0.8, -sun[1] * height * 0.8];
    let far = Slab { centre: [house.centre[0] + throw[0], house.centre[1] + throw[1]], ..*house };
    let corners: Vec<P> = house.corners().into_iter().chain(far.corners()).collect();
    let (x0, x1, y0, y1) = canvas.bounds(&corners, 1.0);
    for y in y0..y1 {
        for x in x0..x1 {
            let p = canvas.middle(x, y);
            let deepest = (1..=6)
                .map(|k| {
                    let t = k as f32 / 6.0;
                    Slab { centre: [house.centre[0] + throw[0] * t, house.centre[1] + throw[1] * t], ..*house }.signed(p)
                })
                .fold(f32::MAX, f32::min);
            let dark = canvas.coverage(deepest);
            if dark > 0.0 {
                canvas.shade(y * canvas.width + x, 1.0 - 0.52 * dark);
            }
        }
    }
    let mut parts = vec![*house];
    if !works && dice.chance(0.4) {
        let wing = Slab {
            centre: house.place(house.half_u * dice.range32(-0.6, 0.6), house.half_v * dice.range32(0.5, 0.9)),
            half_u: house.half_u * dice.range32(0.3, 0.55),
            half_v: house.half_v * dice.range32(0.5, 0.8),
            axis: house.axis,
        };
        parts.push(wing);
    }
    let houses: [Rgb; 8] = [
        [222.0, 216.0, 206.0],
        [204.0, 194.0, 178.0],
        [186.0, 178.0, 170.0],
        [150.0, 146.0, 144.0],
        [172.0, 106.0, 80.0],
        [148.0, 88.0, 70.0],
        [112.0, 108.0, 108.0],
        [196.0, 170.0, 134.0],
    ];
    let sheds: [Rgb; 7] = [
        [228.0, 230.0, 232.0],
        [196.0, 200.0, 204.0],
        [150.0, 160.0, 168.0],
        [92.0, 118.0, 150.0],
        [120.0, 134.0, 118.0],
        [168.0, 122.0, 98.0],
        [96.0, 98.0, 104.0],
    ];
    let base = if works { dice.pick(&sheds, [200.0; 3]) } else { dice.pick(&houses, [200.0; 3]) };
    let (shift, seed) = (dice.range32(-14.0, 14.0), dice.seed());
    let base = base.map(|c| c + shift);
    let style = if works { 2 + dice.below(2) } else { dice.below(3) };
    let rib = dice.range32(2.2, 5.5);
    for part in &parts {
        let facing = -part.axis[1] * sun[0] + part.axis[0] * sun[1];
        canvas.paint(&part.corners(), 1.0, |p| {
            let d = part.signed(p);
            let [u, v] = part.local(p);
            let stain = 0.07 * fbm(p[0] / 7.0, p[1] / 7.0, 2, seed);
            let light = match style {
                // Flat, with a parapet.
                0 => 1.0 + if d > -1.0 { 0.12 } else { 0.0 },
                // Gable: one side to the sun.
                1 => 1.0 + 0.2 * facing * v.signum() + if v.abs() < 0.5 { 0.08 } else { 0.0 },
                // Ribbed metal or tiles.
                2 => 1.0 + 0.05 * (u / rib * 6.28).sin() + 0.1 * facing * v.signum(),
                // Shed with skylights.
                _ => 1.0 + if (u / rib).rem_euclid(2.5) < 0.4 && v.abs() < part.half_v * 0.8 { 0.14 } else { 0.0 },
            };
            Some((base.map(|c| c * (light + stain)), (0.5 - d / mpp).clamp(0.0, 1.0), Some(Cover::Building)))
        });
    }
    // Roof clutter: plant, tanks, stair heads.
    let count = if style == 0 || works { dice.below(5) } else { 0 };
    for _ in 0..count {
        let box_ = Slab {
            centre: house.place(house.half_u * dice.range32(-0.8, 0.8), house.half_v * dice.range32(-0.8, 0.8)),
            half_u: dice.range32(0.7, 2.2),
            half_v: dice.range32(0.7, 1.8),
            axis: house.axis,
        };
        let tone = dice.range32(70.0, 240.0);
        canvas.paint(&box_.corners(), 1.0, |p| Some(([tone; 3], 0.85 * (0.5 - box_.signed(p) / mpp).clamp(0.0, 1.0), None)));
    }
}

/// A paved lot with stalls and cars, or a storage yard with stacks.
pub fn lot(canvas: &mut Canvas, at: P, terrain: &Terrain, taken: &mut Taken, dice: &mut Dice) {
    let angle = dice.range32(0.0, 3.14);
    let lot =
        Slab { centre: at, half_u: dice.range32(14.0, 48.0), half_v: dice.range32(12.0, 34.0), axis: [angle.cos(), angle.sin()] };
    if !free(&lot, taken) || terrain.shore_m(at) < 60.0_f32.min(lot.half_u + 8.0) {
        return;
    }
    occupy(&lot, taken);
    let (seed, storage) = (dice.seed(), dice.chance(0.5));
    let tone = dice.range32(96.0, 190.0);
    let mpp = canvas.mpp;
    let cover = if tone < 140.0 { Cover::Road } else { Cover::Bare };
    canvas.paint(&lot.corners(), 1.0, |p| {
        let light = 1.0 + 0.12 * fbm(p[0] / 14.0, p[1] / 14.0, 3, seed);
        Some(([tone, tone * 0.97, tone * 0.93].map(|c| c * light), (0.5 - lot.signed(p) / mpp).clamp(0.0, 1.0), Some(cover)))
    });
    let (du, dv) = if storage { (dice.range32(6.0, 13.0), dice.range32(4.0, 9.0)) } else { (2.9, 8.0) };
    let (nu, nv) = ((lot.half_u / du) as i32, (lot.half_v / dv) as i32);
    for i in -nu + 1..nu {
        for j in -nv + 1..nv {
            if white(i, j, seed) + 0.8 * value(i as f32 / 4.0, j as f32 / 2.0, seed ^ 5) < 0.35 {
                continue;
            }
            let item = Slab {
                centre: lot.place(i as f32 * du + 0.3 * white(j, i, seed), j as f32 * dv + 0.5 * white(i, j, seed ^ 9)),
                half_u: if storage { du * 0.5 * (0.5 + 0.4 * white(i, j, seed ^ 3).abs()) } else { 0.95 },
                half_v: if storage { dv * 0.36 } else { 2.2 },
                axis: lot.axis,
            };
            let [r, g, b] = [dice.range32(40.0, 235.0), dice.range32(-30.0, 30.0), dice.range32(-40.0, 40.0)];
            canvas.paint(&item.corners(), 1.0, |p| {
                Some(([r, r + g, r + b], 0.9 * (0.5 - item.signed(p) / mpp).clamp(0.0, 1.0), None))
            });
        }
    }
}
