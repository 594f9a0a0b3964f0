//! Blocks of feature cells, transformed: overlap-save.

use super::super::correlate::Work;
use crate::model::Tensor;
use rustfft::Fft;
use rustfft::num_complex::Complex32;
use std::sync::Arc;

/// Part of a product that stays in the first cache while all channels are added up.
const PIECE: usize = 2048;

/// Transforms of one size.
pub struct Transforms {
    /// N.
    pub n: usize,
    /// Forward.
    pub forward: Arc<dyn Fft<f32>>,
    /// And back, without its factor.
    pub inverse: Arc<dyn Fft<f32>>,
}

impl Transforms {
    /// Buffers.
    pub fn work(&self) -> Work {
        Work::new(self.n, self.forward.get_inplace_scratch_len().max(self.inverse.get_inplace_scratch_len()))
    }

    /// Spectra of the pairs of channels of `[C, cells, cells]` (an odd last one alone).
    pub fn spectra(&self, work: &mut Work, features: &[f32], cells: usize) -> Vec<Complex32> {
        let plane = cells * cells;
        let mut spectra = Vec::with_capacity(features.len().div_ceil(2 * plane.max(1)) * self.n * self.n);
        for pair in features.chunks(2 * plane.max(1)) {
            let (real, imaginary) = pair.split_at(plane.min(pair.len()));
            work.load(real, imaginary, cells);
            work.transform(cells, &*self.forward);
            spectra.extend_from_slice(&work.columns);
        }
        spectra
    }

    /// The same of the block inside `rim` cells of `[1, C, H, W]`.
    pub fn tile_spectra(&self, work: &mut Work, features: &Tensor, rim: usize) -> Vec<Complex32> {
        let [_, _, height, width] = features.shape[..] else { return Vec::new() };
        let mut inner = Vec::with_capacity(features.data.len());
        for plane in features.data.chunks_exact((height * width).max(1)) {
            for row in plane.chunks_exact(width).skip(rim).take(self.n) {
                inner.extend(row.iter().skip(rim).take(self.n));
            }
        }
        self.spectra(work, &inner, self.n)
    }

    /// Logits at the first `shifts` x `shifts` shifts: the real part of the inverse transform of `sum conj(F) M`.
    pub fn correlate(&self, work: &mut Work, frame: &[Complex32], map: &[Complex32], shifts: usize) -> Vec<f32> {
        let plane = self.n * self.n;
        let mut product = vec![Complex32::default(); plane];
        for (i, sums) in product.chunks_mut(PIECE).enumerate() {
            let span = i * PIECE..i * PIECE + sums.len();
            for (frame, map) in frame.chunks_exact(plane).zip(map.chunks_exact(plane)) {
                let (frame, map) = (frame.get(span.clone()).unwrap_or_default(), map.get(span.clone()).unwrap_or_default());
                for ((sum, f), m) in sums.iter_mut().zip(frame).zip(map) {
                    sum.re += f.re * m.re + f.im * m.im;
                    sum.im += f.re * m.im - f.im * m.re;
                }
            }
        }
        let mut logits = Vec::with_capacity(shifts * shifts);
        work.inverse_into(&mut product, [shifts; 2], &*self.inverse, &mut logits);
        logits
    }
}
