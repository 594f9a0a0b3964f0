//! From a satellite picture to how the same ground glows at night.
//!
//! This renderer stands in for reality in the evaluation; training never uses it. Temperatures follow what is known of
//! night thermal images: water and asphalt keep the day's heat, roofs face the cold sky, vegetation stays near the air,
//! dry sand loses much and moist soil little. Numbers are drawn per flight, so that the contrast of two materials may
//! turn over from one flight to the next.
//!
//! Order: materials -> albedo and colour -> texture and relief -> roofs -> changes since the picture -> thermal inertia.

mod changes;
mod materials;
pub mod raster;

use super::noise::{Dice, SlowField, fbm};
use materials::{Material, Materials};
use raster::{blur, components, gap, k_means};

pub use materials::guess_cover;

/// The picture to start from: a square of ground.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Side, pixels.
    pub size_px: usize,
    /// Metres per pixel.
    pub m_per_px: f32,
    /// Interleaved RGB.
    pub rgb: Vec<u8>,
    /// 1 where there is a picture.
    pub valid: Vec<u8>,
    /// Land cover (see [`super::world::Cover`]), 0 where unknown.
    pub cover: Vec<u8>,
}

/// How the ground glows, degrees Celsius (apparent).
#[derive(Debug, Clone)]
pub struct NightField {
    /// Side, pixels.
    pub size_px: usize,
    /// Row-major.
    pub celsius: Vec<f32>,
}

/// Renders the whole scene once: every frame of a flight is then a view of the same night.
pub fn render(scene: &Scene, seed: u64) -> NightField {
    let (n, mpp) = (scene.size_px, scene.m_per_px);
    let mut dice = Dice::new(seed, 100);
    let materials = Materials::draw(&mut dice);

    let luma: Vec<f32> = scene
        .rgb
        .chunks_exact(3)
        .map(|p| p.iter().zip([0.299, 0.587, 0.114]).map(|(v, w)| f32::from(*v) * w).sum::<f32>() / 255.0)
        .collect();
    // Three bands of the picture: what a material is (broad), its texture (fine), its relief (middle).
    let mut broad = luma.clone();
    blur(&mut broad, n, n, 5.0 / mpp);
    let mut middle = luma.clone();
    blur(&mut middle, n, n, 2.2 / mpp);

    let means = albedo_statistics(scene, &luma);
    let tint = ColourTint::draw(scene, &mut dice);
    let (labels, count) = components(|i| scene.cover.get(i) == Some(&1), n, n);
    let roofs: Vec<Roof> = (0..=count).map(|_| Roof::draw(&mut dice)).collect();
    let slow = slow_field(n as f32 * mpp, &mut dice);
    let seeds: Vec<u32> = (0..4).map(|_| dice.seed()).collect();
    let seed_of = |i: usize| seeds.get(i).copied().unwrap_or(0);
    let evening = dice.range32(0.0, std::f32::consts::TAU);
    let (last_sun, relief_gain) = ([evening.cos(), evening.sin()], dice.normal32(0.0, 9.0));

    let mut celsius = vec![0.0_f32; n * n];
    for (index, out) in celsius.iter_mut().enumerate() {
        let (x, y) = (index % n, index / n);
        let (px, py) = (x as f32 * mpp, y as f32 * mpp);
        let at = |image: &[f32], i: usize| image.get(i).copied().unwrap_or(0.0);
        let label = labels.get(index).copied().unwrap_or(0) as usize;
        let roof = roofs.get(label).copied().unwrap_or_default();
        let mut cover = scene.cover.get(index).copied().unwrap_or(0);
        if cover == 1 && roof.gone {
            cover = 2;
        }
        let material: &Material = materials.of(cover);
        let (mean, spread) = means.get(usize::from(cover)).copied().unwrap_or((0.5, 0.2));
        // Parked and passing cars are not where the picture saw them: roads keep only broad tones.
        let tone = if cover == 3 || (label > 0 && roof.gone) { at(&broad, index) } else { at(&luma, index) };
        let albedo = ((tone - mean) / spread.max(0.06)).clamp(-2.5, 2.5);
        let texture = (tone - at(&broad, index)).clamp(-0.25, 0.25);
        let fine = fbm(px / 6.0, py / 6.0, 2, seed_of(0));
        let coarse = fbm(px / 31.0, py / 31.0, 3, seed_of(1));
        let mut t = material.celsius + material.per_albedo * albedo + material.per_texture * texture;
        t += material.fine_k * fine + material.coarse_k * coarse + slow.at(px, py);
        t += material.tint * tint.at(scene.rgb.get(index * 3..index * 3 + 3).unwrap_or(&[]));
        if cover == 1 {
            t += roof.offset_k;
        } else if cover == 2 && x >= 2 && y >= 2 && x + 2 < n && y + 2 < n {
            // Bright slopes in the picture faced the sun of the picture; which slopes are warm is another matter.
            let gx = at(&middle, index + 2) - at(&middle, index - 2);
            let gy = at(&middle, index + 2 * n) - at(&middle, index - 2 * n);
            t += relief_gain * (gx * last_sun[0] + gy * last_sun[1]).clamp(-0.08, 0.08);
        }
        *out = t;
    }
    let wall_k = dice.normal32(0.9, 0.5);
    changes::walls(
        &mut celsius,
        n,
        |i| labels.get(i).is_some_and(|&l| l > 0 && roofs.get(l as usize).is_some_and(|r| !r.gone)),
        wall_k,
    );
    changes::patches(&mut celsius, scene, &mut dice);
    changes::new_buildings(&mut celsius, scene, &materials, count, &mut dice);
    // Heat spreads sideways in the ground before it is seen.
    blur(&mut celsius, n, n, 0.9 / mpp);
    changes::vehicles(&mut celsius, scene, &mut dice);
    changes::clutter(&mut celsius, scene, &mut dice);
    NightField { size_px: n, celsius }
}

/// One roof.
#[derive(Debug, Clone, Copy, Default)]
struct Roof {
    offset_k: f32,
    /// Demolished since the picture, or not built yet when it was taken the other way round.
    gone: bool,
}

impl Roof {
    fn draw(dice: &mut Dice) -> Self {
        let metal = dice.chance(0.2);
        Self { offset_k: dice.normal32(if metal { -3.0 } else { 0.3 }, 1.6), gone: dice.chance(0.05) }
    }
}

/// Mean and standard deviation of the albedo, per land cover.
fn albedo_statistics(scene: &Scene, luma: &[f32]) -> Vec<(f32, f32)> {
    let mut sums = [(0.0_f64, 0.0_f64, 0.0_f64); 6];
    for ((cover, valid), l) in scene.cover.iter().zip(&scene.valid).zip(luma) {
        if let (1, Some((n, s, q))) = (*valid, sums.get_mut(usize::from(*cover))) {
            let l = f64::from(*l);
            (*n, *s, *q) = (*n + 1.0, *s + l, *q + l * l);
        }
    }
    sums.iter()
        .map(|(n, s, q)| {
            let mean = s / n.max(1.0);
            (mean as f32, (q / n.max(1.0) - mean * mean).max(0.0).sqrt() as f32)
        })
        .collect()
}

/// Kinds of soil, crop and paving by colour: each has a warmth of its own.
struct ColourTint {
    middles: Vec<[f32; 3]>,
    kelvin: Vec<f32>,
}

impl ColourTint {
    fn draw(scene: &Scene, dice: &mut Dice) -> Self {
        let pixels = scene.rgb.len() / 3;
        let mut samples = Vec::with_capacity(12_000);
        for _ in 0..40_000 {
            let index = dice.below(pixels);
            if let (Some(1), Some(&[r, g, b])) = (scene.valid.get(index), scene.rgb.get(index * 3..index * 3 + 3)) {
                samples.push([r, g, b].map(f32::from));
            }
            if samples.len() >= 12_000 {
                break;
            }
        }
        let start = (0..7).map(|_| dice.pick(&samples, [128.0; 3])).collect();
        let middles = k_means(&samples, start, 8);
        let kelvin = middles.iter().map(|_| dice.normal32(0.0, 0.8)).collect();
        Self { middles, kelvin }
    }
    fn at(&self, pixel: &[u8]) -> f32 {
        let &[r, g, b] = pixel else { return 0.0 };
        let colour = [r, g, b].map(f32::from);
        let (mut sum, mut total) = (0.0, 0.0);
        for (middle, kelvin) in self.middles.iter().zip(&self.kelvin) {
            let weight = 1.0 / (gap(&colour, middle) + 500.0).powi(2);
            sum += weight * kelvin;
            total += weight;
        }
        sum / f32::max(total, 1e-12)
    }
}

/// Weather and cold air in hollows: slow differences that no picture shows.
fn slow_field(side_m: f32, dice: &mut Dice) -> SlowField {
    let (far, near) = (dice.seed(), dice.seed());
    SlowField::new(side_m, side_m, 16.0, |x, y| {
        1.1 * fbm(x / 1400.0, y / 1400.0, 2, far) + 0.6 * fbm(x / 260.0, y / 260.0, 3, near)
    })
}

#[cfg(test)]
mod tests;
