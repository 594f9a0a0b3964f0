//! A rectangle of the map, contiguous in memory, and the loops that sample it.
//!
//! A pixel is four 16-bit lanes of one `u64` (red, green, blue, validity), so that one multiplication weighs all of them.

use super::lattice::Point;
use super::resample::Reduction;
use super::tiles::Tiles;
use super::{GeoTiff, MapError};

/// Pixels a block may hold: a map whose scale varies so much within a window is none.
const MAX_PIXELS: usize = 1 << 24;
/// Fractional bits of a sampling coordinate.
const BITS: u32 = 16;
const LANES: u64 = 0x00ff_00ff_00ff_00ff;
const HALF: u64 = 0x0080_0080_0080_0080;
const VALID: u64 = 255;

/// Spreads a tile's packed pixel to lanes.
#[inline(always)]
fn spread(pixel: u32) -> u64 {
    let p = u64::from(pixel);
    (p & 0xff) | (p & 0xff00) << 8 | (p & 0x00ff_0000) << 16 | (p & 0xff00_0000) << 24
}

/// A loaded rectangle of reduced map pixels with a border of invalid ones where the map ends.
#[derive(Default)]
pub(super) struct Block {
    /// Reduced pixel of the first element.
    origin: [i64; 2],
    width: usize,
    height: usize,
    pixels: Vec<u64>,
    /// Sums while boxes are averaged: red, green, blue, validity.
    sums: Vec<[u32; 4]>,
}

impl Block {
    /// Loads the reduced pixels between `low` and `high` that the map has; `false` where it has none.
    pub fn load(
        &mut self,
        map: &GeoTiff,
        tiles: &mut Tiles,
        reduction: &Reduction,
        low: Point,
        high: Point,
        window_pixels: usize,
    ) -> Result<bool, MapError> {
        let Some(level) = map.levels().get(reduction.level) else { return Ok(false) };
        let size = [level.width as usize, level.height as usize];
        let (mut first, mut last) = ([0_usize; 2], [0_usize; 2]);
        for axis in 0..2 {
            let count = size[axis].div_ceil(reduction.boxes[axis]);
            let (from, to) = (low[axis].floor().max(0.0), high[axis].ceil().min(count as f64 - 1.0));
            if !(from <= to) {
                return Ok(false);
            }
            (first[axis], last[axis]) = (from as usize, to as usize);
        }
        // The border: a sample between the map's last pixel and nothing is invalid, not an index error.
        self.origin = first.map(|f| f as i64 - 1);
        (self.width, self.height) = (last[0] - first[0] + 3, last[1] - first[1] + 3);
        let pixels = self.width.saturating_mul(self.height);
        if pixels > MAX_PIXELS {
            return Err(MapError::Format {
                path: map.path().to_owned(),
                field: "scale",
                expected: format!("about one map pixel per pixel of {window_pixels}"),
                found: format!("{pixels}: the window lies where the projection is singular"),
            });
        }
        self.pixels.clear();
        self.pixels.resize(pixels, 0);
        let boxes = reduction.boxes;
        // Level pixels [start, end) to copy.
        let start = [first[0] * boxes[0], first[1] * boxes[1]];
        let end = [((last[0] + 1) * boxes[0]).min(size[0]), ((last[1] + 1) * boxes[1]).min(size[1])];
        let averaged = boxes != [1, 1];
        if averaged {
            self.sums.clear();
            self.sums.resize(pixels, [0; 4]);
        }
        let (chunk_w, chunk_h) = (level.chunk_width as usize, level.chunk_height as usize);
        for row in start[1] / chunk_h..end[1].div_ceil(chunk_h) {
            for column in start[0] / chunk_w..end[0].div_ceil(chunk_w) {
                let chunk = (row * level.across() as usize + column) as u32;
                let Some(tile) = tiles.get(map, reduction.level, chunk)? else { continue };
                let (x0, x1) = ((column * chunk_w).max(start[0]), ((column + 1) * chunk_w).min(end[0]));
                for y in (row * chunk_h).max(start[1])..((row + 1) * chunk_h).min(end[1]) {
                    let offset = (y - row * chunk_h) * tile.width;
                    let within = offset + x0 - column * chunk_w..offset + x1 - column * chunk_w;
                    let Some(source) = tile.pixels.get(within) else { continue };
                    let line = (y / boxes[1] - first[1] + 1) * self.width + 1;
                    if averaged {
                        self.add(line, x0, first[0], boxes[0], source);
                    } else if let Some(target) = self.pixels.get_mut(line + x0 - start[0]..line + x1 - start[0]) {
                        target.iter_mut().zip(source).for_each(|(to, &from)| *to = spread(from));
                    }
                }
            }
        }
        if averaged {
            self.average((boxes[0] * boxes[1]) as u32);
        }
        Ok(true)
    }

    /// Adds a row of level pixels that starts at `x` to the sums of the line of reduced pixels that starts at `first`.
    fn add(&mut self, line: usize, x: usize, first: usize, width: usize, source: &[u32]) {
        let Some(sums) = self.sums.get_mut(line..) else { return };
        let mut rest = source;
        let mut at = x;
        while !rest.is_empty() {
            let count = (width - at % width).min(rest.len());
            let (now, later) = rest.split_at(count);
            // At most 4096 x 255 a row: no overflow before 4096 rows.
            let mut total = [0_u32; 4];
            for pixel in now {
                for (sum, byte) in total.iter_mut().zip(pixel.to_le_bytes()) {
                    *sum += u32::from(byte);
                }
            }
            if let Some(sum) = sums.get_mut(at / width - first) {
                sum.iter_mut().zip(total).for_each(|(s, t)| *s = s.saturating_add(t));
            }
            at += count;
            rest = later;
        }
    }

    /// Sums to means; a box with any invalid pixel (or beyond the map's edge) stays invalid.
    fn average(&mut self, count: u32) {
        for (pixel, sums) in self.pixels.iter_mut().zip(&self.sums) {
            let [r, g, b, valid] = *sums;
            if u64::from(valid) == VALID * u64::from(count) {
                let mean = |sum: u32| u64::from(sum / count) + u64::from(sum % count * 2 >= count);
                *pixel = mean(r) | mean(g) << 16 | mean(b) << 32 | VALID << 48;
            }
        }
    }

    /// Samples a run of window pixels: the first at reduced pixel `from`, each next one `step` further.
    pub fn row(&self, from: Point, step: Point, rgb: &mut [u8], valid: &mut [u8]) {
        let (mut at, step) = (self.fixed(from), step.map(fixed));
        for (rgb, valid) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(valid) {
            store(self.bilinear(at), rgb, valid);
            at = [at[0] + step[0], at[1] + step[1]];
        }
    }

    /// As [`Block::row`], each pixel the mean of `samples` x `samples` points spread evenly over it; `down` is the step to the
    /// next row.
    pub fn row_averaged(&self, from: Point, step: Point, down: Point, samples: usize, rgb: &mut [u8], valid: &mut [u8]) {
        let place = |i: usize| (i as f64 + 0.5) / samples as f64 - 0.5;
        let offsets: Vec<[i64; 2]> = (0..samples * samples)
            .map(|i| [0, 1].map(|axis| fixed(step[axis] * place(i % samples) + down[axis] * place(i / samples))))
            .collect();
        let count = offsets.len() as u64;
        let (mut at, step) = (self.fixed(from), step.map(fixed));
        for (rgb, valid) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(valid) {
            // At most 9 x 255 in a lane.
            let sum: u64 = offsets.iter().map(|o| self.bilinear([at[0] + o[0], at[1] + o[1]])).sum();
            let mean = |lane: u32| ((sum >> lane & 0xffff) * 2 + count) / (2 * count);
            let whole = sum >> 48 == VALID * count;
            store(if whole { mean(0) | mean(16) << 16 | mean(32) << 32 | VALID << 48 } else { 0 }, rgb, valid);
            at = [at[0] + step[0], at[1] + step[1]];
        }
    }

    /// A point relative to the block, in fixed point, rounded to the 1/256 px that weights resolve.
    fn fixed(&self, at: Point) -> [i64; 2] {
        [0, 1].map(|axis| fixed(at[axis] - self.origin[axis] as f64) + (1 << (BITS - 9)))
    }

    /// The four neighbours of a point, weighed; invalid (0) unless all that count are valid.
    #[inline(always)]
    fn bilinear(&self, at: [i64; 2]) -> u64 {
        let (x, y) = ((at[0] >> BITS) as usize, (at[1] >> BITS) as usize);
        // Negative coordinates have become huge.
        if x >= self.width - 1 || y >= self.height - 1 {
            return 0;
        }
        let upper = y * self.width + x;
        let lower = upper + self.width;
        let (Some(&[p00, p10]), Some(&[p01, p11])) =
            (self.pixels.get(upper..).and_then(|s| s.first_chunk()), self.pixels.get(lower..).and_then(|s| s.first_chunk()))
        else {
            return 0;
        };
        let (u, v) = ((at[0] >> (BITS - 8)) as u64 & 255, (at[1] >> (BITS - 8)) as u64 & 255);
        // Weights of 256 in all: rounding one makes the others whole, and none negative.
        let both = (u * v + 128) >> 8;
        let sum = p00 * (256 + both - u - v) + p10 * (u - both) + p01 * (v - both) + p11 * both;
        (sum + HALF) >> 8 & LANES
    }
}

/// To fixed point; far off the map the value does not matter, but must not overflow when steps are added.
fn fixed(value: f64) -> i64 {
    (value.clamp(-1e9, 1e9) * f64::from(1 << BITS)).round() as i64
}

/// Writes one pixel.
#[inline(always)]
fn store(sample: u64, rgb: &mut [u8; 3], valid: &mut u8) {
    let all = u64::from(sample >> 48 == VALID);
    let sample = sample & all.wrapping_neg();
    *rgb = [sample as u8, (sample >> 16) as u8, (sample >> 32) as u8];
    *valid = all as u8;
}
