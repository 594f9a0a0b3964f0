//! The frame under hypotheses of yaw and scale.
//!
//! Hypothesis (theta, s): the true yaw is the assumed one plus theta (clockwise), the true footprint is the assumed one
//! times s. On true ground, the point (e, n) metres from the frame's centre is then seen in the assumed frame at
//! R(-theta) (e, n) / s. In pixels, x right and y down, turning clockwise by theta is
//! `[[cos, -sin], [sin, cos]]`, so output pixel offset (x, y) samples the assumed frame at
//! `(cos x + sin y, -sin x + cos y) / s`.

use super::inputs::{FrameView, SeenGray};
use crate::model::{CorrelationStage, Tensor};

/// One hypothesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// True yaw minus assumed yaw, degrees clockwise.
    pub rotation_deg: f64,
    /// True footprint over assumed footprint.
    pub scale: f64,
}

/// Finest step of a search through the whole circle, degrees.
const MIN_CIRCLE_STEP_DEG: f64 = 1.0;

/// The hypotheses a stage tries: rotations (slow index) times scales (fast index), as the manifest lists them. With
/// `whole_circle`, rotations go through 360 degrees instead, evenly, at most the manifest's smallest step apart; `None`
/// where the manifest states a single rotation and so no step.
pub fn hypotheses(stage: &CorrelationStage, whole_circle: bool) -> Option<Vec<Hypothesis>> {
    let rotations = if whole_circle {
        let mut sorted = stage.rotations_deg.clone();
        sorted.sort_by(f64::total_cmp);
        let steps = sorted.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0);
        let step = steps.min_by(f64::total_cmp)?.max(MIN_CIRCLE_STEP_DEG);
        let n = (360.0 / step - 1e-9).ceil().max(1.0);
        (0..n as u32).map(|k| f64::from(k) * 360.0 / n).collect()
    } else {
        stage.rotations_deg.clone()
    };
    let pairs =
        rotations.iter().flat_map(|&rotation_deg| stage.scales.iter().map(move |&scale| Hypothesis { rotation_deg, scale }));
    Some(pairs.collect())
}

/// The frame at twice the input's resolution, from which all hypotheses are sampled.
pub struct Turner {
    fine: SeenGray,
    size_px: usize,
}

impl Turner {
    /// Step A: [`FrameView::resized`] to twice `size_px`.
    pub fn new(frame: &FrameView<'_>, size_px: usize) -> Self {
        Self { fine: frame.resized(2 * size_px), size_px }
    }

    /// Step B: each output pixel is the mean of 2 x 2 bilinear samples of gray x seen and of seen, at +-0.25 output pixels
    /// in the turned and scaled position. `seen = [mean seen >= 0.5]`, `gray = mean gray / mean seen` there, 0 elsewhere.
    pub fn turned(&self, hypothesis: &Hypothesis) -> SeenGray {
        let n = self.size_px;
        let (sin, cos) = hypothesis.rotation_deg.to_radians().sin_cos();
        let (sin, cos) = (sin / hypothesis.scale, cos / hypothesis.scale);
        let middle = (n as f64 - 1.0) / 2.0;
        let fine_middle = (2 * n) as f64 / 2.0 - 0.5;
        let mut out = SeenGray { size_px: n, gray: vec![0.0; n * n], seen: vec![0.0; n * n] };
        for (v, (gray, seen)) in out.gray.chunks_exact_mut(n).zip(out.seen.chunks_exact_mut(n)).enumerate() {
            for (u, (gray, seen)) in gray.iter_mut().zip(seen).enumerate() {
                let mut sum = [0.0; 2];
                for dv in [-0.25, 0.25] {
                    for du in [-0.25, 0.25] {
                        let (x, y) = (u as f64 + du - middle, v as f64 + dv - middle);
                        // Two fine pixels to an output pixel.
                        let x_fine = fine_middle + 2.0 * (cos * x + sin * y);
                        let y_fine = fine_middle + 2.0 * (cos * y - sin * x);
                        self.add_sample(x_fine as f32, y_fine as f32, &mut sum);
                    }
                }
                if sum[1] >= 2.0 {
                    (*gray, *seen) = (sum[0] / sum[1], 1.0);
                }
            }
        }
        out
    }

    /// Adds the bilinear sample of (gray x seen, seen), 0 outside.
    #[inline]
    fn add_sample(&self, x: f32, y: f32, sum: &mut [f32; 2]) {
        let side = self.fine.size_px as isize;
        // Shifted by one so that cutting off is rounding down from -1 on.
        if !(x > -1.0 && y > -1.0) {
            return;
        }
        let (x0, y0) = ((x + 1.0) as isize - 1, (y + 1.0) as isize - 1);
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        for (yi, wy) in [(y0, 1.0 - fy), (y0 + 1, fy)] {
            for (xi, wx) in [(x0, 1.0 - fx), (x0 + 1, fx)] {
                if (0..side).contains(&xi) && (0..side).contains(&yi) {
                    let at = (yi * side + xi) as usize;
                    if let (Some(gray), Some(seen)) = (self.fine.gray.get(at), self.fine.seen.get(at)) {
                        // Gray is 0 where unseen: it is weighted already.
                        sum[0] += wx * wy * gray;
                        sum[1] += wx * wy * seen;
                    }
                }
            }
        }
    }
}

/// The frame inputs of these hypotheses as one batch, `[B, C, n, n]`.
pub fn batch(turner: &Turner, stage: &CorrelationStage, hypotheses: &[Hypothesis]) -> Tensor {
    let n = stage.frame.size_px as usize;
    let channels = stage.frame.content.channels();
    let mut data = Vec::with_capacity(hypotheses.len() * channels * n * n);
    for hypothesis in hypotheses {
        data.extend(turner.turned(hypothesis).channels(stage.frame.content));
    }
    Tensor { shape: vec![hypotheses.len(), channels, n, n], data }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(paint: impl Fn(usize, usize) -> u8) -> Vec<u8> {
        (0..512 * 512).map(|i| paint(i % 512, i / 512)).collect()
    }

    #[test]
    fn the_null_hypothesis_is_the_mean_of_two_by_two() {
        let gray = frame(|x, y| ((x * 3 + y * 5) % 256) as u8);
        let seen = vec![1; 512 * 512];
        let turner = Turner::new(&FrameView { size_px: 512, gray: &gray, seen: &seen }, 96);
        let out = turner.turned(&Hypothesis { rotation_deg: 0.0, scale: 1.0 });
        let at = |x: usize, y: usize| turner.fine.gray[y * 192 + x];
        let expected = (at(80, 20) + at(81, 20) + at(80, 21) + at(81, 21)) / 4.0;
        assert!((out.gray[10 * 96 + 40] - expected).abs() < 1e-6);
        assert!(out.seen.iter().all(|s| *s == 1.0));
    }

    /// A bright spot 100 m north of the centre in the assumed frame: with a true yaw 90 degrees further clockwise it lies
    /// to the east, and with a footprint 1.2 times as large 120 m away.
    #[test]
    fn positive_rotation_is_clockwise_and_scale_is_outwards() {
        let gray = frame(|x, y| if (255.5 - x as f64).hypot(155.5 - y as f64) < 12.0 { 255 } else { 0 });
        let seen = vec![1; 512 * 512];
        let turner = Turner::new(&FrameView { size_px: 512, gray: &gray, seen: &seen }, 96);
        let out = turner.turned(&Hypothesis { rotation_deg: 90.0, scale: 1.2 });
        let weight: f32 = out.gray.iter().sum();
        let east_px = out.gray.iter().enumerate().map(|(i, g)| g * (i % 96) as f32).sum::<f32>() / weight - 47.5;
        let south_px = out.gray.iter().enumerate().map(|(i, g)| g * (i / 96) as f32).sum::<f32>() / weight - 47.5;
        let m_per_px = 512.0 / 96.0;
        assert!((east_px * m_per_px - 120.0).abs() < 0.5 && (south_px * m_per_px).abs() < 0.5, "{east_px} {south_px}");
    }

    #[test]
    fn corners_turned_in_from_outside_are_unseen() {
        let gray = frame(|_, _| 128);
        let seen = vec![1; 512 * 512];
        let turner = Turner::new(&FrameView { size_px: 512, gray: &gray, seen: &seen }, 96);
        let out = turner.turned(&Hypothesis { rotation_deg: 45.0, scale: 1.0 });
        assert_eq!((out.seen[0], out.gray[0]), (0.0, 0.0));
        assert!((out.gray[48 * 96 + 48] - 128.0 / 255.0).abs() < 1e-5);
    }
}
