//! From logits to a place: the posterior over all hypotheses and all places in the search disc, its peak to a fraction of
//! a cell, and what speaks for it.
//!
//! Definitions (mirrored in Python, `sthn.correlate`). `l(b, p)` is the logit of hypothesis b at shift p = (dx, dy).
//! * Places: `D_b` = shifts whose place of the *vehicle* under hypothesis b lies within R of the prior; at least the cells
//!   within half a cell's diagonal.
//! * Posterior: `P(b, p) = softmax` of l over all b and all p in `D_b`. Best: its argmax (b*, p*), the first of equals.
//! * Sub-cell: p* plus the mean of the offsets in the (2r + 1)^2 square weighted by softmax of `l(b*, p* + offset)`; the
//!   square is whole, in or out of the disc.
//! * Rotation and scale: `m_b = max l(b, p)` over p within 1 cell of p* (3 x 3); mean of the hypotheses' rotations and
//!   scales weighted by softmax of m_b; rotations are averaged as differences from that of b*, wrapped to (-180, 180].
//! * `M(p) = sum_b P(b, p)`, `N(p)` = sum of M over the (2r + 1)^2 square about p. `peak_mass = N(p*)`;
//!   `second_peak = max N(p) / N(p*)` over p in the disc more than `max(6, 2 sqrt(2) r)` cells from p* (so that both
//!   squares are apart); `entropy_bits` of M.
//! * Nearer than that lie the rivals of a pattern that repeats itself: `S(p)` = sum of M over the 3 x 3 square about p,
//!   `near_peak = max S(p) / S(p*)` over the maxima of M (no less than its eight neighbours, more than none) in the disc
//!   whose square does not touch that of p* (3 cells or more along an axis) and that are no further than `second_peak` looks.

use super::correlate::ShiftRange;
use super::hypotheses::Hypothesis;

/// Cells round the peak that belong to it, at least.
const PEAK_CELLS: f64 = 6.0;

/// What the posterior says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Peak {
    /// Best shift, to a fraction of a cell: x, y.
    pub shift: [f64; 2],
    /// True yaw minus assumed yaw, degrees, -180..=180.
    pub rotation_deg: f64,
    /// True footprint over assumed footprint.
    pub scale: f64,
    /// Posterior mass round the peak.
    pub peak_mass: f64,
    /// Mass round the second place over that round the peak.
    pub second_peak: f64,
    /// The same of the heaviest maximum near the peak, each with the cells that touch it; 0 where there is none.
    pub near_peak: f64,
    /// Entropy of the posterior over places, bits.
    pub entropy_bits: f64,
    /// Highest logit.
    pub peak_logit: f64,
    /// Logarithm of the mass round the peak before the posterior is normalised: of one frame, comparable between discs.
    pub peak_log_mass: f64,
    /// Which hypothesis it is of.
    pub hypothesis: usize,
}

/// Logits with what they are of.
pub struct Surface<'a> {
    /// Shifts.
    pub range: ShiftRange,
    /// Hypotheses.
    pub hypotheses: &'a [Hypothesis],
    /// Hypothesis by hypothesis, row by row.
    pub logits: &'a [f32],
    /// Half side of the square of the soft-argmax, cells. The range reaches this far beyond every allowed shift.
    pub subcell_radius: usize,
}

impl Surface<'_> {
    /// Reads the posterior. `allowed(b, dx, dy)` says whether a shift is a place in the disc under hypothesis b. `None` where
    /// no shift is allowed or a logit is not finite.
    pub fn peak(&self, allowed: impl Fn(usize, i64, i64) -> bool) -> Option<Peak> {
        let [width, height] = self.range.size;
        let plane = width * height;
        if self.logits.len() != plane * self.hypotheses.len() || !self.logits.iter().all(|l| l.is_finite()) {
            return None;
        }
        let allowed_at =
            |b: usize, i: usize| allowed(b, self.range.from[0] + (i % width) as i64, self.range.from[1] + (i / width) as i64);
        let mut best: Option<(f32, usize, usize)> = None;
        for (b, logits) in self.logits.chunks_exact(plane.max(1)).enumerate() {
            for (i, &logit) in logits.iter().enumerate() {
                if best.is_none_or(|(highest, _, _)| logit > highest) && allowed_at(b, i) {
                    best = Some((logit, b, i));
                }
            }
        }
        let (highest, best_b, best_i) = best?;
        let mut mass = vec![0.0f64; plane];
        let mut in_disc = vec![false; plane];
        for (b, logits) in self.logits.chunks_exact(plane).enumerate() {
            for (i, ((&logit, mass), in_disc)) in logits.iter().zip(&mut mass).zip(&mut in_disc).enumerate() {
                if allowed_at(b, i) {
                    *mass += f64::from(logit - highest).exp();
                    *in_disc = true;
                }
            }
        }
        let total: f64 = mass.iter().sum();
        mass.iter_mut().for_each(|m| *m /= total);

        let (x, y) = ((best_i % width) as i64, (best_i / width) as i64);
        let radius = self.subcell_radius as i64;
        let mut centroid = [0.0; 2];
        let mut weight = 0.0;
        for (oy, ox) in (-radius..=radius).flat_map(|oy| (-radius..=radius).map(move |ox| (oy, ox))) {
            if let Some(logit) = self.logit(best_b, x + ox, y + oy) {
                let w = f64::from(logit - highest).exp();
                centroid[0] += w * ox as f64;
                centroid[1] += w * oy as f64;
                weight += w;
            }
        }
        let shift =
            [(self.range.from[0] + x) as f64 + centroid[0] / weight, (self.range.from[1] + y) as f64 + centroid[1] / weight];
        let (rotation_deg, scale) = self.rotation_and_scale(best_b, x, y)?;
        let square = |px: i64, py: i64, radius: i64| -> f64 {
            let square = (-radius..=radius).flat_map(|oy| (-radius..=radius).map(move |ox| (px + ox, py + oy)));
            square.filter_map(|(px, py)| self.index(px, py)).filter_map(|i| mass.get(i)).sum()
        };
        let near = |px: i64, py: i64| square(px, py, radius);
        let at = |px: i64, py: i64| self.index(px, py).and_then(|i| mass.get(i)).copied().unwrap_or(0.0);
        let is_maximum = |px: i64, py: i64| {
            let own = at(px, py);
            own > 0.0 && (-1..=1).all(|oy| (-1..=1).all(|ox| at(px + ox, py + oy) <= own))
        };
        let (peak_mass, own_mass) = (near(x, y), square(x, y, 1));
        let apart = PEAK_CELLS.max(2.0 * std::f64::consts::SQRT_2 * radius as f64);
        let (mut second, mut near_peak) = (0.0f64, 0.0f64);
        for (i, _) in in_disc.iter().enumerate().filter(|(_, in_disc)| **in_disc) {
            let (px, py) = ((i % width) as i64, (i / width) as i64);
            if ((px - x) as f64).hypot((py - y) as f64) > apart {
                second = second.max(near(px, py));
            } else if (px - x).abs().max((py - y).abs()) >= 3 && is_maximum(px, py) {
                near_peak = near_peak.max(square(px, py, 1) / own_mass);
            }
        }
        let entropy_bits = mass.iter().filter(|m| **m > 0.0).map(|m| -m * m.log2()).sum();
        let second_peak = second / peak_mass;
        let peak_logit = f64::from(highest);
        let peak_log_mass = peak_logit + (peak_mass * total).ln();
        Some(Peak {
            shift,
            rotation_deg,
            scale,
            peak_mass,
            second_peak,
            near_peak,
            entropy_bits,
            peak_logit,
            peak_log_mass,
            hypothesis: best_b,
        })
    }

    fn rotation_and_scale(&self, best_b: usize, x: i64, y: i64) -> Option<(f64, f64)> {
        let best = self.hypotheses.get(best_b)?;
        let square = || (-1..=1).flat_map(|oy| (-1..=1).map(move |ox| (ox, oy)));
        let highest = |b: usize| square().filter_map(|(ox, oy)| self.logit(b, x + ox, y + oy)).fold(f32::NEG_INFINITY, f32::max);
        let maxima: Vec<f32> = (0..self.hypotheses.len()).map(highest).collect();
        let top = maxima.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let (mut turn, mut scale, mut weight) = (0.0, 0.0, 0.0);
        for (hypothesis, maximum) in self.hypotheses.iter().zip(&maxima) {
            let w = f64::from(maximum - top).exp();
            turn += w * wrap_deg(hypothesis.rotation_deg - best.rotation_deg);
            scale += w * hypothesis.scale;
            weight += w;
        }
        Some((wrap_deg(best.rotation_deg + turn / weight), scale / weight))
    }

    fn index(&self, x: i64, y: i64) -> Option<usize> {
        let [width, height] = self.range.size;
        let (x, y) = (usize::try_from(x).ok()?, usize::try_from(y).ok()?);
        (x < width && y < height).then_some(y * width + x)
    }

    fn logit(&self, b: usize, x: i64, y: i64) -> Option<f32> {
        self.logits.get(b * self.range.size[0] * self.range.size[1] + self.index(x, y)?).copied()
    }
}

/// An angle in (-180, 180].
pub fn wrap_deg(angle_deg: f64) -> f64 {
    let wrapped = angle_deg.rem_euclid(360.0);
    if wrapped > 180.0 { wrapped - 360.0 } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RANGE: ShiftRange = ShiftRange { from: [-20, -10], size: [41, 31] };

    /// A log-posterior that is a paraboloid (a Gaussian) about `at` in each hypothesis, `depth` lower per hypothesis.
    fn gaussians(at: &[([f64; 2], f64)]) -> Vec<f32> {
        let cell = |i: usize| [(i % 41) as f64 - 20.0, (i / 41) as f64 - 10.0];
        let one = |([x, y], depth): &([f64; 2], f64), i: usize| {
            let [cx, cy] = cell(i);
            (-depth - 0.5 * ((cx - x).powi(2) + (cy - y).powi(2))) as f32
        };
        at.iter().flat_map(|peak| (0..41 * 31).map(move |i| one(peak, i))).collect()
    }

    fn surface<'a>(logits: &'a [f32], hypotheses: &'a [Hypothesis]) -> Surface<'a> {
        Surface { range: RANGE, hypotheses, logits, subcell_radius: 3 }
    }

    #[test]
    fn a_known_peak_is_found_to_a_thousandth_of_a_cell() {
        let one = [Hypothesis { rotation_deg: 0.0, scale: 1.0 }];
        for at in [[0.0, 0.0], [3.3, -2.4], [-7.5, 4.1]] {
            let logits = gaussians(&[(at, 0.0)]);
            // A square of 11 x 11 cells holds all but a millionth of a Gaussian of one cell.
            let peak = Surface { subcell_radius: 5, ..surface(&logits, &one) }.peak(|_, _, _| true).unwrap();
            assert!((peak.shift[0] - at[0]).abs() < 1e-3 && (peak.shift[1] - at[1]).abs() < 1e-3, "{at:?} {peak:?}");
        }
        let sharp: Vec<f32> = gaussians(&[([3.3, -2.4], 0.0)]).iter().map(|l| l * 4.0).collect();
        let peak = surface(&sharp, &one).peak(|_, _, _| true).unwrap();
        assert!((peak.shift[0] - 3.3).abs() < 1e-1 && peak.peak_mass > 0.999 && peak.second_peak < 1e-6, "{peak:?}");
    }

    #[test]
    fn the_disc_masks_and_the_rest_does_not_count() {
        let one = [Hypothesis { rotation_deg: 0.0, scale: 1.0 }];
        let (far, near) = (gaussians(&[([-15.0, 0.0], 0.0)]), gaussians(&[([10.0, 5.0], 3.0)]));
        let logits: Vec<f32> = far.iter().zip(&near).map(|(a, b)| a.max(*b)).collect();
        let peak = surface(&logits, &one).peak(|_, dx, _| dx > 0).unwrap();
        assert!((peak.shift[0] - 10.0).abs() < 1e-3 && peak.peak_mass > 0.99, "{peak:?}");
        let both = surface(&logits, &one).peak(|_, _, _| true).unwrap();
        assert!((both.second_peak - (-3.0f64).exp()).abs() < 1e-3, "{both:?}");
        assert!(surface(&logits, &one).peak(|_, _, _| false).is_none());
    }

    #[test]
    fn rivals_four_cells_away_are_near_peaks_and_a_slope_is_none() {
        let one = [Hypothesis { rotation_deg: 0.0, scale: 1.0 }];
        let two = |depth: f64| -> Vec<f32> {
            let (here, there) = (gaussians(&[([0.0, 0.0], 0.0)]), gaussians(&[([4.0, 0.0], depth)]));
            here.iter().zip(&there).map(|(a, b)| a.max(*b)).collect()
        };
        for depth in [0.1, 1.0, 3.0] {
            let peak = surface(&two(depth), &one).peak(|_, _, _| true).unwrap();
            assert!((peak.near_peak - (-depth).exp()).abs() < 0.01 && peak.second_peak < 0.2, "{depth}: {peak:?}");
            // What lies outside the disc is no rival.
            assert_eq!(surface(&two(depth), &one).peak(|_, dx, _| dx < 3).unwrap().near_peak, 0.0);
        }
        let broad: Vec<f32> = gaussians(&[([0.0, 0.0], 0.0)]).iter().map(|l| l / 9.0).collect();
        assert_eq!(surface(&broad, &one).peak(|_, _, _| true).unwrap().near_peak, 0.0);
    }

    #[test]
    fn rotation_and_scale_are_means_over_hypotheses_across_the_wrap() {
        let turns = [170.0, 180.0, -170.0].map(|rotation_deg| Hypothesis { rotation_deg, scale: 1.0 });
        let logits = gaussians(&[([0.0, 0.0], 1.0), ([0.0, 0.0], 0.0), ([0.0, 0.0], 1.0)]);
        let peak = surface(&logits, &turns).peak(|_, _, _| true).unwrap();
        assert!((peak.rotation_deg - 180.0).abs() < 1e-9, "{peak:?}");
        let scales = [0.9, 1.1].map(|scale| Hypothesis { rotation_deg: 0.0, scale });
        let peak = surface(&gaussians(&[([0.0, 0.0], 0.0), ([0.0, 0.0], 0.0)]), &scales).peak(|_, _, _| true).unwrap();
        assert!((peak.scale - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_flat_posterior_has_the_entropy_of_its_cells() {
        let one = [Hypothesis { rotation_deg: 0.0, scale: 1.0 }];
        let peak = surface(&vec![0.25; 41 * 31], &one).peak(|_, _, _| true).unwrap();
        assert!((peak.entropy_bits - (41.0f64 * 31.0).log2()).abs() < 1e-9);
        assert!(peak.second_peak >= 1.0);
        let mut broken = vec![0.0; 41 * 31];
        broken[7] = f32::NAN;
        assert!(surface(&broken, &one).peak(|_, _, _| true).is_none());
    }
}
