//! Resampling a frame through a homography: block average where it is finer than its target, then bilinear.
//!
//! The rows are tight: which part of a row the frame covers is solved beforehand, coordinates are computed in blocks that
//! vectorise, and the interpolation is in integers, with positions rounded to 1/256 pixel.

use super::pose::field;
use super::{FrameError, GrayFrame};
use nalgebra::{Matrix3, RowVector3};

/// Positions are rounded to `1 / (1 << FRACTION_BITS)` pixel.
const FRACTION_BITS: u32 = 8;
/// Pixels whose coordinates are computed together.
const BLOCK_PX: usize = 64;

/// A frame, averaged over blocks of `step x step` pixels, with a border of one pixel that repeats the edge: within half a
/// pixel outside its outermost centres, interpolation needs no test.
pub(super) struct Source {
    /// For each pixel: itself, its right, its lower and its lower right neighbour, so that one look-up finds all four.
    squares: Vec<[u8; 4]>,
    /// Size without the border.
    width: usize,
    height: usize,
    /// Frame pixel -> pixel of the bordered picture.
    from_frame: Matrix3<f64>,
}

impl Source {
    /// A source with about one pixel per target pixel, where `frame_px_per_target_px` is above 1.5; else the frame itself.
    ///
    /// # Errors
    /// A frame without pixels, or with more or fewer than its size says.
    pub fn reduced(frame: &GrayFrame, frame_px_per_target_px: f64) -> Result<Self, FrameError> {
        let (frame_width, frame_height) = (frame.width as usize, frame.height as usize);
        if frame.pixels.is_empty() || frame_width.checked_mul(frame_height) != Some(frame.pixels.len()) {
            let expected = format!("{frame_width} x {frame_height}, and at least one");
            return Err(field("pixels", expected, frame.pixels.len().to_string()));
        }
        // A NaN becomes 0, and that 1.
        let step = (frame_px_per_target_px.round() as usize).clamp(1, frame_width.min(frame_height));
        let (width, height) = (frame_width / step, frame_height / step);
        // What does not fill a block is left out on both sides alike.
        let (left, top) = ((frame_width - width * step) / 2, (frame_height - height * step) / 2);
        let stride = width + 2;
        let mut pixels = vec![0; stride * (height + 2)];
        for (j, row) in pixels.chunks_exact_mut(stride).enumerate() {
            // The border repeats the first and the last row, then the first and the last column.
            let first = (top + j.saturating_sub(1).min(height - 1) * step) * frame_width + left;
            let rows = (0..step).filter_map(|r| frame.pixels.get(first + r * frame_width..)?.get(..width * step));
            average_blocks(rows, step, row.get_mut(1..=width).unwrap_or_default());
            row.copy_within(1..2, 0);
            row.copy_within(width..=width, width + 1);
        }
        let scale = 1.0 / step as f64;
        let shift = |edge: usize| 1.0 - (edge as f64 + (step as f64 - 1.0) / 2.0) * scale;
        let from_frame = Matrix3::new(scale, 0.0, shift(left), 0.0, scale, shift(top), 0.0, 0.0, 1.0);
        let mut squares = vec![[0; 4]; pixels.len() - stride];
        let lines = pixels.chunks_exact(stride).zip(pixels.chunks_exact(stride).skip(1));
        for (out, (upper, lower)) in squares.chunks_exact_mut(stride).zip(lines) {
            for (square, (ab, cd)) in out.iter_mut().zip(upper.windows(2).zip(lower.windows(2))) {
                if let (&[a, b], &[c, d]) = (ab, cd) {
                    *square = [a, b, c, d];
                }
            }
        }
        Ok(Self { squares, width, height, from_frame })
    }
}

/// Means over `step` rows and `step` columns, rounded half up.
fn average_blocks<'a>(rows: impl Iterator<Item = &'a [u8]>, step: usize, out: &mut [u8]) {
    if step == 1 {
        rows.for_each(|row| out.copy_from_slice(row));
        return;
    }
    let mut sums = vec![0_u32; out.len() * step];
    for row in rows {
        sums.iter_mut().zip(row).for_each(|(sum, &v)| *sum += u32::from(v));
    }
    let count = (step * step) as u32;
    for (mean, block) in out.iter_mut().zip(sums.chunks_exact(step)) {
        *mean = ((block.iter().sum::<u32>() + count / 2) / count) as u8;
    }
}

/// Samples `source` at `frame_from_target` of every pixel of a square of `size_px`: values and where they are valid (1 or
/// 0). Valid is what falls on the frame's area, half a pixel round its outermost centres included, in front of the camera.
pub(super) fn warp(source: &Source, frame_from_target: &Matrix3<f64>, size_px: usize) -> (Vec<u8>, Vec<u8>) {
    let mut pixels = vec![0; size_px * size_px];
    let mut valid = vec![0; size_px * size_px];
    let m = source.from_frame * frame_from_target;
    let middle = (size_px as f64 - 1.0) / 2.0;
    // Nearer to the horizon than this, a square of ground is not what the camera looks at.
    let least_depth = 1e-3 * (m.m31 * middle + m.m32 * middle + m.m33);
    let [across, down, depth] = [m.row(0), m.row(1), m.row(2)].map(|row| row.into_owned());
    let bounds = [
        RowVector3::new(depth[0], depth[1], depth[2] - least_depth),
        across - depth * 0.5,
        depth * (source.width as f64 + 0.5) - across,
        down - depth * 0.5,
        depth * (source.height as f64 + 0.5) - down,
    ];
    for (y, (row, row_valid)) in pixels.chunks_exact_mut(size_px).zip(valid.chunks_exact_mut(size_px)).enumerate() {
        let at_row = |linear: &RowVector3<f64>| Linear { start: linear[1] * y as f64 + linear[2], slope: linear[0] };
        let (first, end) = bounds.iter().fold((0, size_px), |range, bound| at_row(bound).not_negative_within(range));
        if let (Some(row), Some(row_valid)) = (row.get_mut(first..end), row_valid.get_mut(first..end)) {
            sample_row(source, [at_row(&across), at_row(&down), at_row(&depth)], first, row);
            row_valid.fill(1);
        }
    }
    (pixels, valid)
}

/// `start + slope * x`.
#[derive(Debug, Clone, Copy)]
struct Linear {
    start: f64,
    slope: f64,
}

impl Linear {
    /// The part of `first..end` in which the value is not negative (empty as `first..first`).
    fn not_negative_within(self, (first, end): (usize, usize)) -> (usize, usize) {
        let (mut least, mut most) = (first as f64, end as f64 - 1.0);
        // What rounding takes from a frame's own edge is given back.
        let start = self.start + 1e-9 * self.start.abs().max(1.0);
        if self.slope > 0.0 {
            least = least.max((-start / self.slope).ceil());
        } else if self.slope < 0.0 {
            most = most.min((start / -self.slope).floor());
        } else if start.is_nan() || start < 0.0 {
            return (first, first);
        }
        if most >= least { (least as usize, most as usize + 1) } else { (first, first) }
    }

    fn at_f32(self, x: f64) -> (f32, f32) {
        ((self.start + self.slope * x) as f32, self.slope as f32)
    }
}

/// Fills a part of a row that begins at column `first` and lies wholly on the source.
fn sample_row(source: &Source, [across, down, depth]: [Linear; 3], first: usize, row: &mut [u8]) {
    let one = (1_u32 << FRACTION_BITS) as f32;
    // Whole numbers as f32: converted once, as a conversion from usize would not vectorise.
    let ramp: [f32; BLOCK_PX] = std::array::from_fn(|i| i as f32);
    let (mut us, mut vs) = ([0_u32; BLOCK_PX], [0_u32; BLOCK_PX]);
    for (k, block) in row.chunks_mut(BLOCK_PX).enumerate() {
        let x = (first + k * BLOCK_PX) as f64;
        // Parallel rays (nadir): the depth is one number.
        if depth.slope == 0.0 {
            let scaled =
                |linear: Linear| Linear { start: linear.start / depth.start, slope: linear.slope / depth.start }.at_f32(x);
            let ((u, du), (v, dv)) = (scaled(across), scaled(down));
            for (&i, (fixed_u, fixed_v)) in ramp.iter().zip(us.iter_mut().zip(&mut vs)) {
                *fixed_u = rounded((u + du * i) * one);
                *fixed_v = rounded((v + dv * i) * one);
            }
        } else {
            let ((u, du), (v, dv), (w, dw)) = (across.at_f32(x), down.at_f32(x), depth.at_f32(x));
            for (&i, (fixed_u, fixed_v)) in ramp.iter().zip(us.iter_mut().zip(&mut vs)) {
                let scale = one / (w + dw * i);
                *fixed_u = rounded((u + du * i) * scale);
                *fixed_v = rounded((v + dv * i) * scale);
            }
        }
        for (out, (&u, &v)) in block.iter_mut().zip(us.iter().zip(&vs)) {
            *out = source.bilinear(u, v);
        }
    }
}

/// The nearest whole number, for 0 ..= 2^22: what is added moves the point so that the mantissa's last bit is worth 1.
/// A cast would do the same, but does not vectorise on every target.
#[inline]
fn rounded(value: f32) -> u32 {
    const SHIFT: f32 = (1 << 23) as f32;
    (value + SHIFT).to_bits().wrapping_sub(SHIFT.to_bits())
}

impl Source {
    /// The value at a position in units of `1 / (1 << FRACTION_BITS)` pixel of the bordered picture; 0 outside it.
    #[inline]
    fn bilinear(&self, u: u32, v: u32) -> u8 {
        let at = (v >> FRACTION_BITS) as usize * (self.width + 2) + (u >> FRACTION_BITS) as usize;
        let Some(&[a, b, c, d]) = self.squares.get(at) else { return 0 };
        let mask = (1 << FRACTION_BITS) - 1;
        let (fu, fv) = (u & mask, v & mask);
        // Both rows at once, the upper in the low half word and the lower in the high one. What a difference borrows from its
        // neighbour comes back with the sum.
        let left = u32::from_le_bytes([a, 0, c, 0]);
        let right = u32::from_le_bytes([b, 0, d, 0]);
        let both = (left << FRACTION_BITS).wrapping_add(right.wrapping_sub(left).wrapping_mul(fu));
        let (upper, lower) = (both & 0xffff, both >> 16);
        let half = 1 << (2 * FRACTION_BITS - 1);
        ((upper << FRACTION_BITS).wrapping_add(lower.wrapping_sub(upper).wrapping_mul(fv)).wrapping_add(half)
            >> (2 * FRACTION_BITS)) as u8
    }
}
