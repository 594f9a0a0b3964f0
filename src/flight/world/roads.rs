//! Roads of several widths: highways across the map, country roads between settlements, dirt roads, junctions.

use super::canvas::{Canvas, Cover, P, Rgb, distance, smooth};
use super::terrain::Terrain;
use crate::flight::noise::{Dice, fbm, lerp, value};

/// What a road is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Two carriageways and a median.
    Highway,
    /// Asphalt, two lanes.
    Street,
    /// Dirt.
    Dirt,
}

/// A road's centre line.
#[derive(Debug, Clone)]
pub struct Road {
    /// Points, metres, a few metres apart.
    pub line: Vec<P>,
    /// Half of the paved width, metres.
    pub half_m: f32,
    /// Surface.
    pub kind: Kind,
}

/// What stands where, on a 2 m lattice, so that nothing is built twice.
#[derive(Debug, Clone)]
pub struct Taken {
    width: usize,
    height: usize,
    cells: Vec<bool>,
}

impl Taken {
    /// Nothing taken yet.
    pub fn new(size_m: P) -> Self {
        let (width, height) = ((size_m[0] / 2.0) as usize + 1, (size_m[1] / 2.0) as usize + 1);
        Self { width, height, cells: vec![false; width * height] }
    }
    /// Whether a place is taken; outside the map everything is.
    pub fn at(&self, p: P) -> bool {
        if p[0] < 0.0 || p[1] < 0.0 {
            return true;
        }
        let (x, y) = ((p[0] / 2.0) as usize, (p[1] / 2.0) as usize);
        x >= self.width || y >= self.height || self.cells.get(y * self.width + x).copied().unwrap_or(true)
    }
    /// Takes a disc.
    pub fn take(&mut self, p: P, radius_m: f32) {
        let reach = (radius_m / 2.0).ceil() as i32;
        let (cx, cy) = ((p[0] / 2.0) as i32, (p[1] / 2.0) as i32);
        for y in (cy - reach).max(0)..=(cy + reach).min(self.height as i32 - 1) {
            for x in (cx - reach).max(0)..=(cx + reach).min(self.width as i32 - 1) {
                let close = distance([x as f32 * 2.0 + 1.0, y as f32 * 2.0 + 1.0], p) <= radius_m + 1.0;
                if let (true, Some(cell)) = (close, self.cells.get_mut(y as usize * self.width + x as usize)) {
                    *cell = true;
                }
            }
        }
    }
    /// Takes a line with its sides.
    pub fn take_line(&mut self, line: &[P], half_m: f32) {
        for p in line {
            self.take(*p, half_m);
        }
    }
}

/// Highways and country roads that join the given places.
pub fn plan(size_m: P, places: &[P], dice: &mut Dice) -> Vec<Road> {
    let [w, h] = size_m;
    let mut roads = Vec::new();
    let highways = if w.max(h) < 1500.0 { 1 } else { 2 };
    for i in 0..highways {
        let upright = (i % 2 == 0) ^ dice.chance(0.5);
        let (from, to) = (dice.range32(0.1, 0.9), dice.range32(0.1, 0.9));
        let count = ((w.max(h) / 800.0).ceil() as usize).max(3);
        let knots: Vec<P> = (0..=count)
            .map(|k| {
                let t = -0.06 + 1.12 * k as f32 / count as f32;
                let side = lerp(from, to, t) + dice.normal32(0.0, 0.035);
                if upright { [side * w, t * h] } else { [t * w, side * h] }
            })
            .collect();
        roads.push(Road { line: smooth(&knots, 5.0), half_m: dice.range32(9.0, 15.0), kind: Kind::Highway });
    }
    // Every place is joined to its nearest already-joined neighbour or highway point, some to a second one.
    let anchors: Vec<P> = roads.iter().flat_map(|r| r.line.iter().copied().step_by(20)).collect();
    for (i, &place) in places.iter().enumerate() {
        let mut targets: Vec<P> = anchors.iter().copied().chain(places.iter().take(i).copied()).collect();
        targets.sort_by(|a, b| distance(*a, place).total_cmp(&distance(*b, place)));
        let second = targets.iter().copied().find(|t| targets.first().is_some_and(|f| distance(*t, *f) > 500.0));
        let picks = [targets.first().copied(), second.filter(|_| dice.chance(0.6))];
        for target in picks.into_iter().flatten().filter(|t| distance(*t, place) > 20.0) {
            let line = wander(place, target, 0.12, dice);
            roads.push(Road { line, half_m: dice.range32(3.2, 5.5), kind: Kind::Street });
        }
    }
    // Dirt roads between random places.
    for _ in 0..(f64::from(w * h) / 16e6 * 60.0).ceil() as usize {
        let from = [dice.range32(0.0, w), dice.range32(0.0, h)];
        let (angle, length) = (dice.range32(0.0, 6.28), dice.range32(250.0, 1100.0));
        let line = wander(from, [from[0] + length * angle.cos(), from[1] + length * angle.sin()], 0.2, dice);
        roads.push(Road { line, half_m: dice.range32(1.6, 3.0), kind: Kind::Dirt });
    }
    roads
}

/// A bending way from one place to another.
pub fn wander(from: P, to: P, bend: f32, dice: &mut Dice) -> Vec<P> {
    let length = distance(from, to);
    let count = ((length / 170.0).round() as usize).max(2);
    let normal = [-(to[1] - from[1]) / length.max(1.0), (to[0] - from[0]) / length.max(1.0)];
    let sway = dice.normal32(0.0, bend * length);
    let knots: Vec<P> = (0..=count)
        .map(|k| {
            let t = k as f32 / count as f32;
            let inner = if k == 0 || k == count { 0.0 } else { 1.0 };
            let off = sway * (std::f32::consts::PI * t).sin() + inner * dice.normal32(0.0, bend * 130.0);
            [lerp(from[0], to[0], t) + normal[0] * off, lerp(from[1], to[1], t) + normal[1] * off]
        })
        .collect();
    smooth(&knots, 5.0)
}

/// Paints a road with shoulders, surface, markings and wear.
pub fn paint(canvas: &mut Canvas, road: &Road, terrain: &Terrain, dice: &mut Dice) {
    let (seed, shade) = (dice.seed(), dice.range32(-16.0, 22.0));
    let surface: Rgb = match road.kind {
        Kind::Dirt => [206.0, 190.0, 160.0].map(|c| c + shade),
        _ => [88.0, 86.0, 86.0].map(|c| c + shade),
    };
    let (half, kind, mpp) = (road.half_m, road.kind, canvas.mpp);
    let shoulder = match kind {
        Kind::Highway => dice.range32(3.0, 8.0),
        Kind::Street => dice.range32(1.0, 3.5),
        Kind::Dirt => 0.8,
    };
    let median = if kind == Kind::Highway { dice.range32(0.8, 2.6) } else { 0.0 };
    let planted = dice.chance(0.5);
    let edge = move |signed: f32| (0.5 - signed / mpp).clamp(0.0, 1.0);
    if kind != Kind::Dirt {
        canvas.stroke(&road.line, half + shoulder + 2.0, |d, s, p| {
            let width = half + shoulder * (1.0 + 0.4 * value(s / 50.0, 0.0, seed));
            let colour = [190.0, 176.0, 152.0].map(|c| c * (1.0 + 0.08 * fbm(p[0] / 8.0, p[1] / 8.0, 2, seed)));
            let bridge = if terrain.shore_m(p) < 0.0 { 0.0 } else { 0.75 };
            Some((colour, edge(d.abs() - width) * bridge, (bridge > 0.0).then_some(Cover::Bare)))
        });
    }
    canvas.stroke(&road.line, half + 2.0, |d, s, p| {
        let wear = fbm(s / 70.0, d / 6.0, 3, seed) * 0.11 + 0.05 * value(p[0] / 3.0, p[1] / 3.0, seed);
        let mut colour = surface.map(|c| c * (1.0 + wear));
        let mut cover = Cover::Road;
        let a = d.abs();
        match kind {
            Kind::Highway => {
                let lane = (half - median) / 2.0;
                let line = (a - median - lane).abs() < 0.4 || (a - half + 0.7).abs() < 0.4;
                if line {
                    colour = colour.map(|c| lerp(c, 215.0, 0.4 / mpp.max(1.0)));
                }
                if a < median {
                    (colour, cover) =
                        if planted { ([92.0, 104.0, 62.0], Cover::Vegetation) } else { ([184.0, 172.0, 150.0], Cover::Bare) };
                }
            }
            Kind::Street => {
                if a < 0.3 && (s / 9.0).fract() < 0.5 {
                    colour = colour.map(|c| lerp(c, 220.0, 0.35 / mpp.max(1.0)));
                }
                // The wheels polish two bands.
                colour = colour.map(|c| c * (1.0 - 0.05 * ((a / half - 0.45) * 6.0).cos()));
            }
            Kind::Dirt => {
                let rut = ((a - 0.5 * half) / 0.7).powi(2);
                colour = colour.map(|c| c * (1.0 - 0.10 * (-rut).exp()));
                if terrain.shore_m(p) < 3.0 {
                    return None;
                }
            }
        }
        let ragged = if kind == Kind::Dirt { 0.9 * value(p[0] / 9.0, p[1] / 9.0, seed) } else { 0.0 };
        Some((colour, edge(a - half + ragged) * if kind == Kind::Dirt { 0.85 } else { 1.0 }, Some(cover)))
    });
}

/// A roundabout with a planted or paved island.
pub fn roundabout(canvas: &mut Canvas, at: P, dice: &mut Dice) {
    let (outer, inner, seed) = (dice.range32(17.0, 30.0), dice.range32(7.0, 13.0), dice.seed());
    let green = dice.chance(0.6);
    let mpp = canvas.mpp;
    canvas.paint(&[at], outer + 2.0, |p| {
        let r = distance(p, at);
        let ring = ([94.0, 92.0, 92.0].map(|c| c * (1.0 + 0.08 * fbm(p[0] / 9.0, p[1] / 9.0, 2, seed))), Some(Cover::Road));
        let island =
            if green { ([84.0, 104.0, 58.0], Some(Cover::Vegetation)) } else { ([198.0, 186.0, 164.0], Some(Cover::Bare)) };
        let (colour, cover) = if r < inner { island } else { ring };
        Some((colour, (0.5 - (r - outer) / mpp).clamp(0.0, 1.0), cover))
    });
}
