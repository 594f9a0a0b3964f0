//! Dense cross-correlation of frame features with map features by FFT.
//!
//! `logit(b, dy, dx) = sum over c, y, x of Ff[b, c, y, x] Fm[c, y + dy, x + dx]`, 0 outside the map's features. Two real
//! channels are packed into one complex one: the real part of `sum conj(F) M` is the wanted correlation of both, so that
//! C channels cost C / 2 transforms. Only the part of the map that the asked shifts reach is transformed; its spectrum is
//! kept while that part stays the same.

use crate::model::Tensor;
use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlanner};
use std::sync::Arc;

/// A rectangle of shifts (dx, dy), in feature cells: frame cell (0, 0) lies on map cell (dx, dy).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ShiftRange {
    /// Least dx and dy.
    pub from: [i64; 2],
    /// Number of shifts along x and y.
    pub size: [usize; 2],
}

/// The part of a map's features that a range of shifts reaches, transformed.
struct Spectrum {
    range: ShiftRange,
    frame_cells: usize,
    n: usize,
    /// For every pair of channels `n x n` values, column by column.
    pairs: Vec<Complex32>,
}

/// Correlates with one map's features.
pub struct Correlator {
    map: Tensor,
    planner: FftPlanner<f32>,
    spectrum: Option<Spectrum>,
}

impl std::fmt::Debug for Correlator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Correlator").field("map", &self.map.shape).finish_non_exhaustive()
    }
}

impl Correlator {
    /// For map features `[1, C, H, W]`.
    pub fn new(map: Tensor) -> Self {
        Self { map, planner: FftPlanner::new(), spectrum: None }
    }

    /// The map's features.
    pub fn map(&self) -> &Tensor {
        &self.map
    }

    /// The logits of frame features `[B, C, h, w]` (h = w) at every shift of `range`: `B x size_y x size_x` values. `None`
    /// where the shapes do not fit.
    pub fn correlate(&mut self, frame: &Tensor, range: &ShiftRange) -> Option<Vec<f32>> {
        let [batch, channels, cells, width] = frame.shape[..] else { return None };
        let [_, map_channels, _, _] = self.map.shape[..] else { return None };
        if channels != map_channels || cells != width || range.size.contains(&0) || cells == 0 {
            return None;
        }
        let reach = range.size[0].max(range.size[1]).checked_add(cells)? - 1;
        let n = good_size(reach);
        let forward = self.planner.plan_fft_forward(n);
        let inverse = self.planner.plan_fft_inverse(n);
        let kept = self.spectrum.take().filter(|s| s.range == *range && s.frame_cells == cells && s.n == n);
        let spectrum = kept.unwrap_or_else(|| self.transform_map(range, cells, n, &forward));
        let mut work = Work::new(n, forward.get_inplace_scratch_len().max(inverse.get_inplace_scratch_len()));
        let mut logits = Vec::with_capacity(batch * range.size[0] * range.size[1]);
        let frame_pair = 2 * cells * cells;
        for item in frame.data.chunks_exact(channels * cells * cells) {
            let mut product = vec![Complex32::default(); n * n];
            // The last of an odd number of channels is its own pair: `chunks` gives it alone.
            for (pair, map) in item.chunks(frame_pair).zip(spectrum.pairs.chunks_exact(n * n)) {
                let (real, imaginary) = pair.split_at(cells * cells);
                work.load(real, imaginary, cells);
                work.transform(cells, &*forward);
                for ((sum, f), m) in product.iter_mut().zip(&work.columns).zip(map) {
                    *sum += f.conj() * m;
                }
            }
            work.inverse_into(&mut product, range.size, &*inverse, &mut logits);
        }
        self.spectrum = Some(spectrum);
        Some(logits)
    }

    /// Transforms the part of the map under `range`.
    fn transform_map(&self, range: &ShiftRange, cells: usize, n: usize, forward: &Arc<dyn Fft<f32>>) -> Spectrum {
        let (channels, height, width) = (self.map.shape[1], self.map.shape[2], self.map.shape[3]);
        let reach = [range.size[0] + cells - 1, range.size[1] + cells - 1];
        let plane = height * width;
        let mut work = Work::new(n, forward.get_inplace_scratch_len());
        let mut pairs = Vec::with_capacity(channels.div_ceil(2) * n * n);
        // A row of the map, and which of its columns fall into the part.
        let (left, right) = (range.from[0].clamp(0, width as i64), (range.from[0] + reach[0] as i64).clamp(0, width as i64));
        for pair in self.map.data.chunks(2 * plane.max(1)) {
            work.rows.fill(Complex32::default());
            for (y, row) in work.rows.chunks_exact_mut(n).take(reach[1]).enumerate() {
                let line = usize::try_from(range.from[1] + y as i64).ok().filter(|&line| line < height && left < right);
                let Some(line) = line else { continue };
                let span = line * width + left as usize..line * width + right as usize;
                let to = (left - range.from[0]) as usize;
                for (value, real) in row.iter_mut().skip(to).zip(pair.get(span.clone()).unwrap_or_default()) {
                    value.re = *real;
                }
                let second = plane + span.start..plane + span.end;
                for (value, imaginary) in row.iter_mut().skip(to).zip(pair.get(second).unwrap_or_default()) {
                    value.im = *imaginary;
                }
            }
            work.transform(reach[1], &**forward);
            pairs.extend_from_slice(&work.columns);
        }
        Spectrum { range: *range, frame_cells: cells, n, pairs }
    }
}

/// Buffers of one transform size.
pub(super) struct Work {
    n: usize,
    rows: Vec<Complex32>,
    /// The transform, column by column.
    pub columns: Vec<Complex32>,
    scratch: Vec<Complex32>,
}

impl Work {
    /// For transforms of `n` values that need this much scratch.
    pub fn new(n: usize, scratch: usize) -> Self {
        let zeros = |len: usize| vec![Complex32::default(); len];
        Self { n, rows: zeros(n * n), columns: zeros(n * n), scratch: zeros(scratch) }
    }

    /// Loads a pair of square planes into the top left of the rows.
    pub fn load(&mut self, real: &[f32], imaginary: &[f32], cells: usize) {
        for (y, row) in self.rows.chunks_exact_mut(self.n).take(cells).enumerate() {
            row.fill(Complex32::default());
            let span = y * cells..(y + 1) * cells;
            for (value, real) in row.iter_mut().zip(real.get(span.clone()).unwrap_or_default()) {
                value.re = *real;
            }
            for (value, imaginary) in row.iter_mut().zip(imaginary.get(span).unwrap_or_default()) {
                value.im = *imaginary;
            }
        }
    }

    /// Transforms the first `used` rows (the others are zero), then all columns, into `columns`.
    pub fn transform(&mut self, used: usize, fft: &dyn Fft<f32>) {
        let n = self.n;
        let used = used.min(n);
        if let Some(rows) = self.rows.get_mut(..used * n) {
            fft.process_with_scratch(rows, &mut self.scratch);
        }
        for (x, column) in self.columns.chunks_exact_mut(n).enumerate() {
            let (filled, rest) = column.split_at_mut(used);
            for (value, from) in filled.iter_mut().zip(self.rows.iter().skip(x).step_by(n)) {
                *value = *from;
            }
            rest.fill(Complex32::default());
        }
        fft.process_with_scratch(&mut self.columns, &mut self.scratch);
    }

    /// Transforms a product (columns) back and appends its real part at the first `size` shifts.
    pub fn inverse_into(&mut self, product: &mut [Complex32], size: [usize; 2], fft: &dyn Fft<f32>, logits: &mut Vec<f32>) {
        let n = self.n;
        fft.process_with_scratch(product, &mut self.scratch);
        let scale = 1.0 / (n * n) as f32;
        let rows = size[1].min(n);
        for (y, row) in self.rows.chunks_exact_mut(n).take(rows).enumerate() {
            for (value, from) in row.iter_mut().zip(product.iter().skip(y).step_by(n)) {
                *value = *from;
            }
        }
        if let Some(rows) = self.rows.get_mut(..rows * n) {
            fft.process_with_scratch(rows, &mut self.scratch);
        }
        for row in self.rows.chunks_exact(n).take(rows) {
            logits.extend(row.iter().take(size[0]).map(|value| value.re * scale));
        }
    }
}

/// The least number from `n` on whose only prime factors are 2, 3 and 5: fast to transform.
fn good_size(n: usize) -> usize {
    let smooth = |mut m: usize| {
        for p in [2, 3, 5] {
            while m % p == 0 {
                m /= p;
            }
        }
        m == 1
    };
    (n.max(1)..).find(|&m| smooth(m)).unwrap_or(n)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    fn random(shape: &[usize], seed: u64) -> Tensor {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let data = (0..shape.iter().product()).map(|_| rng.random_range(-1.0f32..1.0)).collect();
        Tensor { shape: shape.to_vec(), data }
    }

    /// The definition, as it stands in the module's head.
    fn direct(map: &Tensor, frame: &Tensor, b: usize, dx: i64, dy: i64) -> f64 {
        let (c, h, w, n) = (map.shape[1], map.shape[2] as i64, map.shape[3] as i64, frame.shape[2] as i64);
        let mut sum = 0.0;
        for channel in 0..c {
            for y in 0..n {
                for x in 0..n {
                    let (my, mx) = (y + dy, x + dx);
                    if (0..h).contains(&my) && (0..w).contains(&mx) {
                        let f = frame.data[((b * c + channel) as i64 * n * n + y * n + x) as usize];
                        sum += f64::from(f) * f64::from(map.data[(channel as i64 * h * w + my * w + mx) as usize]);
                    }
                }
            }
        }
        sum
    }

    #[test]
    fn equals_the_definition_inside_and_beyond_the_map_for_even_and_odd_channels() {
        for (channels, range) in [
            (4, ShiftRange { from: [0, 0], size: [15, 12] }),
            (3, ShiftRange { from: [-4, -7], size: [30, 30] }),
            (1, ShiftRange { from: [-30, 18], size: [3, 40] }),
        ] {
            let (map, frame) = (random(&[1, channels, 18, 21], 1), random(&[2, channels, 7, 7], 2));
            let mut correlator = Correlator::new(map.clone());
            for _ in 0..2 {
                let logits = correlator.correlate(&frame, &range).unwrap();
                assert_eq!(logits.len(), 2 * range.size[0] * range.size[1]);
                for (i, logit) in logits.iter().enumerate() {
                    let (x, y) = (i % range.size[0], i / range.size[0] % range.size[1]);
                    let b = i / (range.size[0] * range.size[1]);
                    let expected = direct(&map, &frame, b, range.from[0] + x as i64, range.from[1] + y as i64);
                    assert!((f64::from(*logit) - expected).abs() < 1e-4, "{logit} {expected} at {b} {x} {y}");
                }
            }
        }
    }

    #[test]
    fn shapes_that_do_not_fit_give_nothing() {
        let mut correlator = Correlator::new(random(&[1, 2, 9, 9], 1));
        let range = ShiftRange { from: [0, 0], size: [2, 2] };
        assert!(correlator.correlate(&random(&[1, 3, 4, 4], 2), &range).is_none());
        assert!(correlator.correlate(&random(&[1, 2, 4, 5], 2), &range).is_none());
        assert!(correlator.correlate(&random(&[1, 2, 4, 4], 2), &ShiftRange { from: [0, 0], size: [0, 2] }).is_none());
    }

    #[test]
    fn sizes_have_small_factors() {
        assert_eq!([1, 7, 143, 162, 163, 209].map(good_size), [1, 8, 144, 162, 180, 216]);
    }
}
