//! Night temperatures of materials, drawn per flight, and a rule of thumb for what covers the ground where no class map
//! says so.

use super::super::noise::Dice;
use super::super::world::Cover;
use super::raster::blur;

/// How one material glows.
#[derive(Debug, Clone, Copy)]
pub struct Material {
    /// Mean, apparent degrees Celsius.
    pub celsius: f32,
    /// Kelvin per standard deviation of albedo: its sign depends on the material.
    pub per_albedo: f32,
    /// Kelvin per unit of fine luminance.
    pub per_texture: f32,
    /// Share of the colour's own warmth.
    pub tint: f32,
    /// Texture of some metres that the picture does not show, Kelvin.
    pub fine_k: f32,
    /// Texture of some tens of metres, Kelvin.
    pub coarse_k: f32,
}

/// All of them.
#[derive(Debug, Clone)]
pub struct Materials {
    list: [Material; 6],
}

impl Materials {
    /// Draws the materials of one night.
    pub fn draw(dice: &mut Dice) -> Self {
        let mut make =
            |celsius: (f32, f32), albedo: (f32, f32), texture: (f32, f32), tint: f32, fine_k: f32, coarse_k: f32| Material {
                celsius: dice.normal32(celsius.0, celsius.1),
                per_albedo: dice.normal32(albedo.0, albedo.1),
                per_texture: dice.normal32(texture.0, texture.1),
                tint,
                fine_k,
                coarse_k,
            };
        let building = make((14.2, 1.8), (-0.5, 0.7), (-2.0, 3.0), 0.4, 0.15, 0.1);
        let bare = make((17.2, 1.5), (-0.8, 0.6), (-2.0, 3.0), 1.0, 0.22, 0.35);
        let road = make((20.2, 1.4), (-0.6, 0.4), (0.0, 0.8), 0.5, 0.12, 0.3);
        let vegetation = make((17.6, 1.6), (0.3, 0.6), (3.0, 3.0), 0.8, 0.4, 0.35);
        let water = make((21.2, 2.2), (0.1, 0.1), (0.3, 0.5), 0.1, 0.06, 0.12);
        let unknown = make((17.5, 1.0), (-0.6, 0.8), (0.0, 3.0), 1.0, 0.2, 0.3);
        Self { list: [unknown, building, bare, road, vegetation, water] }
    }
    /// The material of a land-cover code; codes that are not known are "unknown".
    pub fn of(&self, cover: u8) -> &Material {
        let [unknown, ..] = &self.list;
        self.list.get(usize::from(cover)).unwrap_or(unknown)
    }
}

/// Guesses land cover from colour and smoothness, pixel by pixel. Crude on purpose: it only has to give every material
/// of a picture a temperature of its own.
pub fn guess_cover(rgb: &[u8], size_px: usize, m_per_px: f32) -> Vec<u8> {
    let pixel = |p: &[u8]| match *p {
        [r, g, b] => [r, g, b].map(|v| f32::from(v) / 255.0),
        _ => [0.0; 3],
    };
    let luma = |[r, g, b]: [f32; 3]| 0.299 * r + 0.587 * g + 0.114 * b;
    let mut mean: Vec<f32> = rgb.chunks_exact(3).map(|p| luma(pixel(p))).collect();
    let mut square: Vec<f32> = mean.iter().map(|v| v * v).collect();
    blur(&mut mean, size_px, size_px, 3.0 / m_per_px);
    blur(&mut square, size_px, size_px, 3.0 / m_per_px);
    rgb.chunks_exact(3)
        .zip(mean.iter().zip(&square))
        .map(|(p, (mean, square))| {
            let [r, g, b] = pixel(p);
            let rough = (square - mean * mean).max(0.0).sqrt();
            let sum = (r + g + b).max(0.05);
            let green = (2.0 * g - r - b) / sum;
            let grey = (r.max(g).max(b) - r.min(g).min(b)) < 0.09;
            let cover = if *mean < 0.24 && rough < 0.045 {
                Cover::Water
            } else if green > 0.06 || (luma([r, g, b]) < 0.33 && g >= r) {
                Cover::Vegetation
            } else if grey && (0.22..0.5).contains(mean) && rough < 0.12 {
                Cover::Road
            } else if *mean > 0.6 && rough > 0.2 && luma([r, g, b]) > 0.75 {
                Cover::Building
            } else {
                Cover::Bare
            };
            cover as u8
        })
        .collect()
}
