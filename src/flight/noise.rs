//! Seeded randomness for the simulator: a drawing helper over ChaCha8, and smooth noise that is a pure function of
//! place and seed, so that the same ground looks the same in every frame.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Draws numbers. ChaCha8 is portable: the same seed gives the same sequence on every machine.
#[derive(Debug, Clone)]
pub struct Dice(ChaCha8Rng);

impl Dice {
    /// A generator for one purpose: `stream` keeps purposes with the same seed independent of each other.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(stream);
        Self(rng)
    }
    /// Uniform in `0.0..1.0` (53 bits).
    pub fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }
    /// Uniform in `from..to`.
    pub fn range(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * self.unit()
    }
    /// Uniform in `from..to`, single precision.
    pub fn range32(&mut self, from: f32, to: f32) -> f32 {
        self.range(f64::from(from), f64::from(to)) as f32
    }
    /// Standard normal. Reference: Box & Muller, Ann. Math. Stat. 29, 1958.
    pub fn normal(&mut self) -> f64 {
        let u = 1.0 - self.unit();
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * self.unit()).cos()
    }
    /// Normal with this mean and standard deviation, single precision.
    pub fn normal32(&mut self, mean: f32, sigma: f32) -> f32 {
        mean + sigma * self.normal() as f32
    }
    /// True with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }
    /// Uniform in `0..count` (0 for an empty range).
    pub fn below(&mut self, count: usize) -> usize {
        ((self.unit() * count as f64) as usize).min(count.saturating_sub(1))
    }
    /// One of the given values.
    pub fn pick<T: Copy>(&mut self, from: &[T], otherwise: T) -> T {
        from.get(self.below(from.len())).copied().unwrap_or(otherwise)
    }
    /// A seed for [`hash`], [`value`] and [`fbm`].
    pub fn seed(&mut self) -> u32 {
        self.0.next_u32()
    }
}

/// A well-mixed hash of a lattice point.
pub fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77) ^ seed.wrapping_mul(0xC2B2_AE3D);
    h ^= h >> 15;
    h = h.wrapping_mul(0x2C1B_3C6D);
    h ^= h >> 12;
    h = h.wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// White noise of a lattice point, -1..=1.
pub fn white(x: i32, y: i32, seed: u32) -> f32 {
    hash(x, y, seed) as f32 * (2.0 / u32::MAX as f32) - 1.0
}

/// Smooth value noise with features about one unit wide, -1..=1.
pub fn value(x: f32, y: f32, seed: u32) -> f32 {
    let (fx, fy) = (x.floor(), y.floor());
    let (ix, iy) = (fx as i32, fy as i32);
    let (tx, ty) = (x - fx, y - fy);
    let (sx, sy) = (tx * tx * (3.0 - 2.0 * tx), ty * ty * (3.0 - 2.0 * ty));
    let top = lerp(white(ix, iy, seed), white(ix.wrapping_add(1), iy, seed), sx);
    let bottom = lerp(white(ix, iy.wrapping_add(1), seed), white(ix.wrapping_add(1), iy.wrapping_add(1), seed), sx);
    lerp(top, bottom, sy)
}

/// Fractal sum of [`value`] over octaves; the axes turn between octaves so that no lattice shows. About -1..=1.
pub fn fbm(x: f32, y: f32, octaves: u32, seed: u32) -> f32 {
    let (mut x, mut y, mut gain, mut sum, mut norm) = (x, y, 1.0_f32, 0.0_f32, 0.0_f32);
    for octave in 0..octaves {
        sum += gain * value(x, y, seed.wrapping_add(octave.wrapping_mul(0x9E37_79B9)));
        norm += gain;
        gain *= 0.5;
        // Rotation by atan(3/4) with a scale of 2.03: incommensurate with the lattice.
        (x, y) = (2.03 * (0.8 * x - 0.6 * y) + 17.3, 2.03 * (0.6 * x + 0.8 * y) - 9.1);
    }
    sum / norm.max(1e-6)
}

/// Linear interpolation.
pub fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// 0 below `from`, 1 above `to`, smooth between (works for `from > to`, falling).
pub fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A slowly varying field sampled on a coarse lattice and read bilinearly: cheap where every pixel asks.
#[derive(Debug, Clone)]
pub struct SlowField {
    step: f32,
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl SlowField {
    /// Samples `f(x, y)` every `step` units over `0..width` x `0..height`.
    pub fn new(width: f32, height: f32, step: f32, f: impl Fn(f32, f32) -> f32) -> Self {
        let (w, h) = ((width / step).ceil() as usize + 2, (height / step).ceil() as usize + 2);
        let mut values = Vec::with_capacity(w * h);
        for j in 0..h {
            for i in 0..w {
                values.push(f(i as f32 * step, j as f32 * step));
            }
        }
        Self { step, width: w, height: h, values }
    }
    /// The field at a place (clamped to the sampled area).
    pub fn at(&self, x: f32, y: f32) -> f32 {
        let (gx, gy) =
            ((x / self.step).clamp(0.0, (self.width - 2) as f32), (y / self.step).clamp(0.0, (self.height - 2) as f32));
        let (i, j) = (gx as usize, gy as usize);
        let (tx, ty) = (gx - i as f32, gy - j as f32);
        let get = |i: usize, j: usize| self.values.get(j * self.width + i).copied().unwrap_or(0.0);
        lerp(lerp(get(i, j), get(i + 1, j), tx), lerp(get(i, j + 1), get(i + 1, j + 1), tx), ty)
    }
}
