//! The ground under everything: biomes, dunes, gravel, tyre tracks, and the water with its shores.

use super::canvas::{Canvas, Cover, P, Rgb, distance, smooth, to_segment};
use crate::flight::noise::{Dice, SlowField, fbm, lerp, smoothstep, value, white};

/// Colours of one world, drawn once.
#[derive(Debug, Clone)]
pub struct Palette {
    sand: Rgb,
    pale: Rgb,
    rock: Rgb,
    steppe: Rgb,
    grass: Rgb,
    deep: Rgb,
    shallow: Rgb,
    /// Unit vector from which the sun shines (towards the sun, x east, y south).
    pub sun: P,
}

impl Palette {
    /// Draws one.
    pub fn new(dice: &mut Dice) -> Self {
        let mut tint = |c: Rgb, spread: f32| {
            let shift = dice.range32(-spread, spread);
            c.map(|v| v + shift + dice.range32(-spread, spread) * 0.4)
        };
        let (sand, pale, rock) =
            (tint([196.0, 178.0, 148.0], 14.0), tint([222.0, 211.0, 190.0], 10.0), tint([142.0, 128.0, 110.0], 14.0));
        let (steppe, grass) = (tint([160.0, 147.0, 106.0], 12.0), tint([108.0, 118.0, 72.0], 12.0));
        let (deep, shallow) = (tint([28.0, 46.0, 50.0], 9.0), tint([74.0, 108.0, 100.0], 14.0));
        let angle = dice.range32(0.9, 2.2);
        Self { sand, pale, rock, steppe, grass, deep, shallow, sun: [angle.cos(), angle.sin()] }
    }
}

/// What later painters ask about the ground.
#[derive(Debug, Clone)]
pub struct Terrain {
    /// Signed distance to the shore, metres (negative in water), only trusted within 60 m of it.
    water_m: Vec<f32>,
    width: usize,
    height: usize,
    mpp: f32,
    /// 0 desert .. 1 green.
    pub moisture: SlowField,
    /// 0 none .. 1 dune field.
    pub dunes: SlowField,
    /// Colours.
    pub palette: Palette,
}

impl Terrain {
    /// Signed distance to the nearest shore, metres; far inland 60.
    pub fn shore_m(&self, p: P) -> f32 {
        let (x, y) = (p[0] / self.mpp, p[1] / self.mpp);
        if x < 0.0 || y < 0.0 || x >= self.width as f32 || y >= self.height as f32 {
            return 60.0;
        }
        self.water_m.get(y as usize * self.width + x as usize).copied().unwrap_or(60.0)
    }
}

/// Paints ground and water.
pub fn paint(canvas: &mut Canvas, dice: &mut Dice) -> Terrain {
    let [w, h] = canvas.size_m();
    let palette = Palette::new(dice);
    let (wet_seed, wet_bias) = (dice.seed(), dice.range32(-0.25, 0.3));
    let moisture =
        SlowField::new(w, h, 16.0, |x, y| smoothstep(-0.35, 0.35, fbm(x / 1300.0, y / 1300.0, 4, wet_seed) + wet_bias));
    let dune_seed = dice.seed();
    let dunes = SlowField::new(w, h, 16.0, |x, y| {
        smoothstep(0.0, 0.25, fbm(x / 900.0, y / 900.0, 3, dune_seed)) * smoothstep(0.6, 0.2, moisture.at(x, y))
    });
    let water_m = water(canvas, dice);
    let terrain = Terrain { water_m, width: canvas.width, height: canvas.height, mpp: canvas.mpp, moisture, dunes, palette };
    ground(canvas, dice, &terrain);
    tracks(canvas, dice, &terrain);
    terrain
}

/// Signed distance to water: one river, some lakes, their outlines roughened.
fn water(canvas: &Canvas, dice: &mut Dice) -> Vec<f32> {
    let [w, h] = canvas.size_m();
    let mut field = vec![60.0_f32; canvas.width * canvas.height];
    let mut lower = |points: &[P], margin: f32, f: &dyn Fn(P) -> f32| {
        let (x0, x1, y0, y1) = canvas.bounds(points, margin);
        for y in y0..y1 {
            for x in x0..x1 {
                if let Some(slot) = field.get_mut(y * canvas.width + x) {
                    *slot = slot.min(f(canvas.middle(x, y)));
                }
            }
        }
    };
    let rough = dice.seed();
    let shore = move |p: P| 5.0 * fbm(p[0] / 55.0, p[1] / 55.0, 3, rough) + 1.2 * value(p[0] / 6.0, p[1] / 6.0, rough ^ 7);
    // The river wanders from one side to the opposite one.
    let scale = w.max(h);
    let upright = dice.chance(0.5);
    let (start, end) = (dice.range32(0.15, 0.85), dice.range32(0.15, 0.85));
    let count = (scale / 420.0).ceil().max(3.0) as usize;
    let (swing, meander) = (dice.range32(90.0, 190.0), dice.seed());
    let knots: Vec<P> = (0..=count)
        .map(|i| {
            let t = -0.05 + 1.1 * i as f32 / count as f32;
            let side =
                lerp(start, end, t) + swing / scale * (1.6 * white(i as i32, 0, meander)) + 0.12 * (t * 5.0 + start * 9.0).sin();
            if upright { [side * w, t * h] } else { [t * w, side * h] }
        })
        .collect();
    let river = smooth(&knots, 12.0);
    let (narrow, wide, width_seed) = (dice.range32(12.0, 20.0), dice.range32(24.0, 40.0), dice.seed());
    for (i, pair) in river.windows(2).enumerate() {
        if let &[a, b] = pair {
            let half = lerp(narrow, wide, 0.5 + 0.5 * value(i as f32 * 12.0 / 260.0, 0.0, width_seed));
            lower(&[a, b], half + 60.0, &|p| to_segment(p, a, b).0.abs() - half + shore(p));
        }
    }
    // Lakes: a radius that varies with the direction.
    let lakes = (f64::from(w * h) / 16e6 * dice.range(6.0, 12.0)).ceil() as usize;
    for _ in 0..lakes {
        let centre = [dice.range32(0.0, w), dice.range32(0.0, h)];
        let (radius, squeeze, turn) =
            (dice.range32(30.0, 150.0) * dice.range32(0.6, 1.5), dice.range32(0.45, 1.0), dice.range32(0.0, 3.1));
        let seed = dice.seed();
        let (sin, cos) = turn.sin_cos();
        lower(&[centre], radius * 1.9 + 60.0, &|p| {
            let (dx, dy) = (p[0] - centre[0], p[1] - centre[1]);
            let (u, v) = (cos * dx + sin * dy, (cos * dy - sin * dx) / squeeze);
            let r = u.hypot(v);
            let bumps = fbm(1.1 * u / radius, 1.1 * v / radius, 3, seed);
            (r - radius * (1.0 + 0.9 * bumps)) * squeeze.sqrt() + shore(p)
        });
    }
    field
}

/// Colours every pixel by biome, relief and water.
fn ground(canvas: &mut Canvas, dice: &mut Dice, terrain: &Terrain) {
    let [w, h] = canvas.size_m();
    let pal = &terrain.palette;
    let seeds: Vec<u32> = (0..8).map(|_| dice.seed()).collect();
    let seed = |i: usize| seeds.get(i).copied().unwrap_or(i as u32);
    let (dir, wave) = (dice.range32(0.0, 3.1), dice.range32(55.0, 95.0));
    let (cos, sin) = (dir.cos(), dir.sin());
    let warp = SlowField::new(w, h, 12.0, |x, y| 2.6 * fbm(x / 260.0, y / 260.0, 4, seed(0)));
    let stone = SlowField::new(w, h, 12.0, |x, y| fbm(x / 330.0, y / 330.0, 4, seed(1)));
    let bleach = SlowField::new(w, h, 10.0, |x, y| fbm(x / 170.0, y / 170.0, 4, seed(2)));
    let wild = SlowField::new(w, h, 8.0, |x, y| fbm(x / 90.0, y / 90.0, 3, seed(3)));
    let mix = |a: Rgb, b: Rgb, t: f32| [lerp(a[0], b[0], t), lerp(a[1], b[1], t), lerp(a[2], b[2], t)];
    for y in 0..canvas.height {
        for x in 0..canvas.width {
            let p = canvas.middle(x, y);
            let wet = terrain.moisture.at(p[0], p[1]);
            let fine = fbm(p[0] / 9.0, p[1] / 9.0, 3, seed(4));
            let rough = fbm(p[0] / 38.0, p[1] / 38.0, 2, seed(5));
            let desert = mix(
                mix(pal.sand, pal.pale, smoothstep(-0.3, 0.5, bleach.at(p[0], p[1]) + 0.3 * rough)),
                pal.rock,
                0.85 * smoothstep(0.12, 0.4, stone.at(p[0], p[1]) + 0.25 * rough + 0.1 * fine),
            );
            let greenness = smoothstep(-0.25, 0.4, wild.at(p[0], p[1]) + 0.35 * rough + 0.15 * fine);
            let green = mix(pal.steppe, pal.grass, greenness);
            let mut colour = mix(desert, green, smoothstep(0.35, 0.75, wet + 0.25 * rough));
            // Gravel sheets and crusts with fairly sharp rims.
            let crust = fbm(p[0] / 62.0, p[1] / 62.0, 4, seed(7));
            let patch = smoothstep(0.16, 0.22, crust) - 0.7 * smoothstep(-0.2, -0.28, crust);
            let mut light = 1.0 + 0.07 * fine + 0.05 * rough - 0.11 * patch * smoothstep(0.8, 0.3, wet);
            let dune = terrain.dunes.at(p[0], p[1]);
            if dune > 0.01 {
                // A leaning wave, bent by a slow warp; the slope towards the sun is bright.
                let phase = (cos * p[0] + sin * p[1]) / wave + warp.at(p[0], p[1]);
                let t = phase - phase.floor();
                let slope =
                    if t < 0.72 { 0.35 - 0.5 * (t / 0.72) } else { -1.0 + 1.35 * smoothstep(0.86, 1.0, t) + 0.4 * (t - 0.72) };
                let ripple = ((cos * p[1] - sin * p[0] * 0.7) / 5.3 + 4.0 * warp.at(p[1], p[0]) + 2.0 * fine).sin();
                let facing = (cos * pal.sun[0] + sin * pal.sun[1]).signum();
                light += dune * (0.26 * slope * facing + 0.05 * ripple);
            }
            let shore = terrain.shore_m(p);
            let mut cover = if wet + 0.25 * rough > 0.55 && greenness > 0.62 { Cover::Vegetation } else { Cover::Bare };
            if shore < 14.0 {
                if shore < 0.0 {
                    let depth = smoothstep(0.0, 24.0, -shore);
                    colour = mix(pal.shallow, pal.deep, depth.sqrt());
                    light = 1.0 + 0.05 * fbm(p[0] / 24.0, p[1] / 60.0, 2, seed(6)) + 0.05 * fine * (1.0 - depth);
                    cover = Cover::Water;
                } else {
                    // Wet sand, then reeds where it is green.
                    let damp = smoothstep(7.0, 0.0, shore);
                    light *= 1.0 - 0.3 * damp;
                    if wet > 0.4 && wild.at(p[0] * 1.7, p[1]) > 0.0 {
                        colour =
                            mix(colour, [74.0, 88.0, 50.0], 0.8 * smoothstep(14.0, 9.0, shore) * smoothstep(1.0, 3.0, shore));
                        cover = Cover::Vegetation;
                    }
                }
            }
            canvas.blend(y * canvas.width + x, colour.map(|v| v * light), 1.0, Some(cover));
        }
    }
}

/// Tyre tracks and dry stream beds: thin wandering lines, never two alike.
fn tracks(canvas: &mut Canvas, dice: &mut Dice, terrain: &Terrain) {
    let [w, h] = canvas.size_m();
    let count = (f64::from(w * h) / 16e6 * 430.0) as usize;
    for _ in 0..count {
        let mut at = [dice.range32(0.0, w), dice.range32(0.0, h)];
        let (mut heading, mut turn) = (dice.range32(0.0, 6.28), 0.0);
        let mut line = vec![at];
        for _ in 0..dice.below(45) + 12 {
            turn = 0.75 * turn + dice.normal32(0.0, 0.13);
            heading += turn;
            at = [at[0] + 18.0 * heading.cos(), at[1] + 18.0 * heading.sin()];
            line.push(at);
        }
        let line = smooth(&line, 6.0);
        let bed = dice.chance(0.3);
        let (half, factor) = if bed {
            (dice.range32(2.0, 7.0), dice.range32(0.72, 1.22))
        } else {
            (dice.range32(0.9, 2.2), if dice.chance(0.6) { dice.range32(0.7, 0.88) } else { dice.range32(1.08, 1.2) })
        };
        let seed = dice.seed();
        let end = line.windows(2).filter_map(|s| Some(distance(*s.first()?, *s.get(1)?))).sum::<f32>();
        let marks: Vec<(usize, f32)> = shading(canvas, &line, half * 2.0 + 2.0, |d, s, p| {
            let half = half * (1.0 + 0.5 * value(s / 40.0, 0.0, seed));
            let fade = smoothstep(0.0, 60.0, s) * smoothstep(end, end - 60.0, s) * (0.6 + 0.4 * value(s / 25.0, 3.0, seed));
            let land = smoothstep(2.0, 8.0, terrain.shore_m(p));
            lerp(1.0, factor, canvas.coverage(d.abs() - half) * fade.clamp(0.0, 1.0) * land)
        });
        for (index, factor) in marks {
            canvas.shade(index, factor);
        }
    }
}

/// Multipliers along a line, each pixel once (by its nearest piece).
fn shading(canvas: &Canvas, line: &[P], reach_m: f32, f: impl Fn(f32, f32, P) -> f32) -> Vec<(usize, f32)> {
    let mut probe = Vec::new();
    let mut along = 0.0;
    for (i, pair) in line.windows(2).enumerate() {
        let &[a, b] = pair else { continue };
        let length = distance(a, b);
        let (before, after) = (i.checked_sub(1).and_then(|k| line.get(k)), line.get(i + 2));
        let (x0, x1, y0, y1) = canvas.bounds(&[a, b], reach_m);
        for y in y0..y1 {
            for x in x0..x1 {
                let p = canvas.middle(x, y);
                let (d, t) = to_segment(p, a, b);
                let beaten = d.abs() > reach_m
                    || before.is_some_and(|&o| to_segment(p, o, a).0.abs() <= d.abs())
                    || after.is_some_and(|&o| to_segment(p, b, o).0.abs() < d.abs());
                if !beaten {
                    probe.push((y * canvas.width + x, f(d, along + t * length, p)));
                }
            }
        }
        along += length;
    }
    probe
}
