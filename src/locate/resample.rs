//! Resampling rules of the bundle contract ([`Resize`]), in f32, outside the networks. Pixel coordinates: an integer is
//! the centre of a pixel.

use crate::model::Resize;

/// Weights of a separable filter: output `i` is the sum of `weights[i]` over the inputs from `starts[i]` on.
pub struct Taps {
    starts: Vec<usize>,
    weights: Vec<Vec<f32>>,
}

impl Taps {
    /// The antialiased bilinear (triangle) filter from `n_in` to `n_out` samples, as torch computes it:
    /// centre `s (i + 0.5)`, half width `max(s, 1)`, taps `j` in `[int(c - w + 0.5), int(c + w + 0.5))`, weight
    /// `1 - |j + 0.5 - c| / w`, normalised. `s` is `n_in / n_out`, and under `align_corners` `(n_in - 1) / (n_out - 1)`:
    /// that rule shifts content by up to `s` towards the right and bottom, and the published weights were trained with it.
    pub fn antialias(n_in: usize, n_out: usize, rule: Resize) -> Self {
        let s = match rule {
            Resize::AlignCornersAntialias if n_out > 1 => (n_in as f64 - 1.0) / (n_out as f64 - 1.0),
            _ => n_in as f64 / n_out.max(1) as f64,
        };
        let half_width = s.max(1.0);
        let (mut starts, mut weights) = (Vec::with_capacity(n_out), Vec::with_capacity(n_out));
        for i in 0..n_out {
            let centre = s * (i as f64 + 0.5);
            // `as usize` cuts off towards zero, as torch's int() does here.
            let start = ((centre - half_width + 0.5).max(0.0) as usize).min(n_in.saturating_sub(1));
            let end = ((centre + half_width + 0.5) as usize).clamp(start + 1, n_in.max(start + 1));
            let raw: Vec<f64> = (start..end).map(|j| (1.0 - (j as f64 + 0.5 - centre).abs() / half_width).max(0.0)).collect();
            let sum: f64 = raw.iter().sum();
            let scale = if sum > 0.0 { 1.0 / sum } else { 0.0 };
            starts.push(start);
            weights.push(raw.into_iter().map(|w| (w * scale) as f32).collect());
        }
        Self { starts, weights }
    }
}

/// Resizes a square of interleaved `channels` (values 0..=255) with the same filter along both axes; the result is planar,
/// `channels x n_out x n_out`, values 0..1.
pub fn resize_u8(source: &[u8], n_in: usize, channels: usize, n_out: usize, rule: Resize) -> Vec<f32> {
    resize(source, n_in, channels, n_out, rule, |v| f32::from(v) / 255.0)
}

/// Resizes a square of values that are in their final unit.
pub fn resize_f32(source: &[f32], n_in: usize, n_out: usize, rule: Resize) -> Vec<f32> {
    resize(source, n_in, 1, n_out, rule, |v| v)
}

/// Rows first (long, contiguous sums), columns after; planar.
fn resize<T: Copy>(source: &[T], n_in: usize, channels: usize, n_out: usize, rule: Resize, value: impl Fn(T) -> f32) -> Vec<f32> {
    let taps = Taps::antialias(n_in, n_out, rule);
    let pitch = n_in * channels;
    let mut out = vec![0.0; channels * n_out * n_out];
    let mut row = vec![0.0f32; pitch];
    for (y, (start, weights)) in taps.starts.iter().zip(&taps.weights).enumerate() {
        row.fill(0.0);
        for (lines, weight) in source.chunks_exact(pitch).skip(*start).zip(weights) {
            for (sum, v) in row.iter_mut().zip(lines) {
                *sum += weight * value(*v);
            }
        }
        for (channel, plane) in out.chunks_exact_mut(n_out * n_out).enumerate() {
            let Some(line) = plane.chunks_exact_mut(n_out).nth(y) else { continue };
            for (to, (start, weights)) in line.iter_mut().zip(taps.starts.iter().zip(&taps.weights)) {
                let samples = row.iter().skip(start * channels + channel).step_by(channels);
                *to = samples.zip(weights).map(|(v, w)| v * w).sum();
            }
        }
    }
    out
}

/// A square image of interleaved RGB bytes, sampled bilinearly; 0 outside.
#[derive(Clone, Copy)]
pub struct RgbSampler<'a> {
    rgb: &'a [u8],
    size_px: usize,
}

impl<'a> RgbSampler<'a> {
    /// `rgb` holds `size_px * size_px * 3` bytes.
    pub fn new(rgb: &'a [u8], size_px: usize) -> Self {
        Self { rgb, size_px }
    }

    /// Adds the bilinear sample at `(x, y)` (0..=255) to `sum`. Taps outside the image count as 0.
    #[inline]
    pub fn add(&self, x: f32, y: f32, sum: &mut [f32; 3]) {
        let pitch = self.size_px * 3;
        let inner = (self.size_px as f32) - 1.0;
        if x >= 0.0 && y >= 0.0 && x < inner && y < inner {
            // Cutting off is rounding down here, and needs no call.
            let (column, line) = (x as usize, y as usize);
            let (fx, fy) = (x - column as f32, y - line as f32);
            let at = line * pitch + column * 3;
            if let (Some(top), Some(bottom)) = (self.rgb.get(at..at + 6), self.rgb.get(at + pitch..at + pitch + 6)) {
                for c in 0..3 {
                    let (a, b) = (f32::from(top[c]), f32::from(top[c + 3]));
                    let (d, e) = (f32::from(bottom[c]), f32::from(bottom[c + 3]));
                    let (upper, lower) = (a + fx * (b - a), d + fx * (e - d));
                    sum[c] += upper + fy * (lower - upper);
                }
                return;
            }
        }
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        // Also the way of NaN and of far-off coordinates: no tap lies inside.
        for (xi, wx) in [(x0, 1.0 - fx), (x0 + 1.0, fx)] {
            for (yi, wy) in [(y0, 1.0 - fy), (y0 + 1.0, fy)] {
                if xi >= 0.0 && yi >= 0.0 && xi <= inner && yi <= inner {
                    let at = yi as usize * pitch + xi as usize * 3;
                    for (sum, v) in sum.iter_mut().zip(self.rgb.iter().skip(at)) {
                        *sum += wx * wy * f32::from(*v);
                    }
                }
            }
        }
    }
}

/// An axis-aligned square crop, `n_out x n_out` samples from `(x_start, y_start)` on, `step` apart: [`Resize::AlignCornersBilinear`].
/// Planar, `3 x n_out x n_out`, values 0..1.
pub fn crop_bilinear(image: &RgbSampler<'_>, x_start: f64, y_start: f64, step: f64, n_out: usize) -> Vec<f32> {
    sample_grid(image, n_out, 1, |u, v| [x_start + u * step, y_start + v * step])
}

/// Samples a grid: [`Resize::Supersample`] with `n x n` samples spread evenly over each output pixel. `place` takes output
/// pixel coordinates to image pixel coordinates and must be affine. Planar, `3 x n_out x n_out`, values 0..1.
pub fn sample_grid(image: &RgbSampler<'_>, n_out: usize, n: usize, place: impl Fn(f64, f64) -> [f64; 2]) -> Vec<f32> {
    let origin = place(0.0, 0.0);
    let (along, down) = (place(1.0, 0.0), place(0.0, 1.0));
    let (along, down) = ([along[0] - origin[0], along[1] - origin[1]], [down[0] - origin[0], down[1] - origin[1]]);
    let offsets: Vec<f64> = (0..n).map(|k| (k as f64 + 0.5) / n as f64 - 0.5).collect();
    let scale = 1.0 / (255.0 * (n * n) as f32);
    let plane = n_out * n_out;
    let mut out = vec![0.0; 3 * plane];
    let (red, rest) = out.split_at_mut(plane);
    let (green, blue) = rest.split_at_mut(plane);
    let rows = red.chunks_exact_mut(n_out).zip(green.chunks_exact_mut(n_out)).zip(blue.chunks_exact_mut(n_out));
    for (v, ((red, green), blue)) in rows.enumerate() {
        for (u, ((red, green), blue)) in red.iter_mut().zip(green.iter_mut()).zip(blue.iter_mut()).enumerate() {
            let mut sum = [0.0; 3];
            for dv in &offsets {
                for du in &offsets {
                    let (u, v) = (u as f64 + du, v as f64 + dv);
                    let x = origin[0] + u * along[0] + v * down[0];
                    let y = origin[1] + u * along[1] + v * down[1];
                    image.add(x as f32, y as f32, &mut sum);
                }
            }
            [*red, *green, *blue] = sum.map(|s| s * scale);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halving_half_pixel_weights_are_1_3_3_1() {
        let taps = Taps::antialias(8, 4, Resize::HalfPixelAntialias);
        assert_eq!((taps.starts[1], &taps.weights[1][..]), (1, &[0.125, 0.375, 0.375, 0.125][..]));
    }

    #[test]
    fn align_corners_antialias_is_centred_at_s_times_i_plus_half() {
        // A ramp keeps its slope; away from the rims output i is the ramp at s (i + 0.5) - 0.5, s = 1535 / 255.
        let ramp: Vec<f32> = (0..1536 * 1536).map(|i| (i % 1536) as f32).collect();
        let out = resize_f32(&ramp, 1536, 256, Resize::AlignCornersAntialias);
        for i in [10usize, 128, 240] {
            let expected = 1535.0 / 255.0 * (i as f64 + 0.5) - 0.5;
            assert!((f64::from(out[128 * 256 + i]) - expected).abs() < 0.05, "{i}: {} {expected}", out[128 * 256 + i]);
        }
    }

    #[test]
    fn sizes_that_stay_are_untouched() {
        let image: Vec<u8> = (0..12 * 12 * 3).map(|i| (i * 7 % 256) as u8).collect();
        for rule in [Resize::HalfPixelAntialias, Resize::AlignCornersAntialias] {
            let out = resize_u8(&image, 12, 3, 12, rule);
            for (i, v) in image.iter().enumerate() {
                assert!((out[(i % 3) * 144 + i / 3] - f32::from(*v) / 255.0).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn crops_are_exact_at_pixel_centres_and_zero_outside() {
        let image: Vec<u8> = (0..5 * 5 * 3).map(|i| i as u8).collect();
        let sampler = RgbSampler::new(&image, 5);
        let out = crop_bilinear(&sampler, -1.0, 3.0, 1.0, 4);
        let expect = |c: usize, x: i64, y: i64| {
            if (0..5).contains(&x) && (0..5).contains(&y) { (y * 15 + x * 3) as f32 + c as f32 } else { 0.0 }
        };
        for c in 0..3 {
            for v in 0..4 {
                for u in 0..4 {
                    let expected = expect(c, u as i64 - 1, v as i64 + 3) / 255.0;
                    assert!((out[c * 16 + v * 4 + u] - expected).abs() < 1e-6, "{c} {u} {v}");
                }
            }
        }
        let mut sum = [0.0; 3];
        for at in [f32::NAN, f32::INFINITY, -1e30, 1e30] {
            sampler.add(at, 2.0, &mut sum);
        }
        assert!(sum.iter().all(|s| s.is_finite()));
    }

    #[test]
    fn supersampling_by_two_is_the_mean_of_two_by_two_pixels() {
        let image: Vec<u8> = (0..8 * 8 * 3).map(|i| (i * 37 % 251) as u8).collect();
        let out = sample_grid(&RgbSampler::new(&image, 8), 4, 2, |u, v| [2.0 * u + 0.5, 2.0 * v + 0.5]);
        let at = |x: usize, y: usize| f32::from(image[(y * 8 + x) * 3 + 1]);
        let expected = (at(2, 4) + at(3, 4) + at(2, 5) + at(3, 5)) / 4.0 / 255.0;
        assert!((out[16 + 2 * 4 + 1] - expected).abs() < 1e-6);
    }
}
