//! What a bundle's calibration makes of evidence: the probability of an error above 25 m and the match error's sigma.
//!
//! Fitted in `models/sthn/integrity` on frames over maps that training never saw, stored in `bundle.toml`, evaluated here.
//! Every cue is transformed, clipped to the range that the calibration saw, and weighted:
//! `score = bias + sum weight x`, `p = knots(score)`, `ln sigma = sigma.bias + sum sigma_weight x`.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The `[integrity]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Integrity {
    /// What it was fitted on.
    pub data: String,
    /// The command that fitted it.
    pub command: String,
    /// Frames it was fitted on.
    pub trials: u64,
    /// Above this an error counts as a wrong place, metres.
    pub bound_m: f64,
    /// Of the score.
    pub bias: f64,
    /// Terms of score and sigma.
    pub cues: Vec<Cue>,
    /// Score -> probability.
    pub probability: Knots,
    /// The match error.
    pub sigma: Sigma,
}

/// One named number of the evidence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cue {
    /// Its key in the evidence.
    pub name: String,
    /// What is done to it first.
    pub transform: Transform,
    /// Least transformed value that the calibration saw; what lies below counts as this.
    pub low: f64,
    /// Largest.
    pub high: f64,
    /// In the score.
    pub weight: f64,
    /// In ln sigma.
    pub sigma_weight: f64,
}

/// Transforms of a cue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Transform {
    /// As it is.
    Linear,
    /// `ln(x + 1e-3)`.
    Log,
    /// `ln((x + 1e-3) / (1 - x + 1e-3))`, x clipped to 0..1.
    Logit,
}

/// A monotone curve: linear between its knots, constant beyond them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Knots {
    /// Rising.
    pub scores: Vec<f64>,
    /// Not falling; 0..1.
    pub p: Vec<f64>,
}

/// The match error, 1-sigma per axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sigma {
    /// Of ln sigma, sigma in metres.
    pub bias: f64,
    /// Never below, metres.
    pub least_m: f64,
    /// Never above, metres.
    pub most_m: f64,
    /// Radius that held all but one in a thousand of the calibration's errors, in sigmas: at least that of a Gaussian.
    pub tail999: f64,
}

/// What the calibration says of a match.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Judgement {
    /// Probability that the error is above the bound.
    pub p_over_bound: f64,
    /// Match error, 1-sigma per axis, metres.
    pub sigma_m: f64,
    /// Radius of 0.999, in sigmas.
    pub tail999: f64,
}

/// A cue that the evidence lacks.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("evidence `{0}`: expected a finite number, found none")]
pub struct MissingCue(pub String);

/// Keeps logarithms finite.
const SMALL: f64 = 1e-3;
/// Quantile of the radius of a two-dimensional standard normal: `sqrt(-2 ln 0.001)`.
const GAUSSIAN_TAIL999: f64 = 3.716_9;

impl Transform {
    /// Applied.
    pub fn apply(self, x: f64) -> f64 {
        match self {
            Self::Linear => x,
            Self::Log => (x.max(0.0) + SMALL).ln(),
            Self::Logit => {
                let x = x.clamp(0.0, 1.0);
                ((x + SMALL) / (1.0 - x + SMALL)).ln()
            }
        }
    }
}

impl Knots {
    /// The curve at a score.
    fn at(&self, score: f64) -> f64 {
        let first = self.p.first().copied().unwrap_or(1.0);
        let mut last = (f64::NEG_INFINITY, first);
        for (&s, &p) in self.scores.iter().zip(&self.p) {
            if score <= s {
                let share = if last.0.is_finite() && s > last.0 { (score - last.0) / (s - last.0) } else { 1.0 };
                return last.1 + (p - last.1) * share;
            }
            last = (s, p);
        }
        last.1
    }
}

impl Integrity {
    /// What the calibration says; an evidence that lacks a cue is an error: what was not seen is not safe.
    pub fn judge(&self, evidence: &BTreeMap<String, f64>) -> Result<Judgement, MissingCue> {
        let (mut score, mut ln_sigma) = (self.bias, self.sigma.bias);
        for cue in &self.cues {
            let found = evidence.get(&cue.name).copied().filter(|x| x.is_finite());
            let x = cue.transform.apply(found.ok_or_else(|| MissingCue(cue.name.clone()))?).clamp(cue.low, cue.high);
            score += cue.weight * x;
            ln_sigma += cue.sigma_weight * x;
        }
        Ok(Judgement {
            p_over_bound: self.probability.at(score),
            sigma_m: ln_sigma.exp().clamp(self.sigma.least_m, self.sigma.most_m),
            tail999: self.sigma.tail999,
        })
    }

    /// The first field that is not what it must be: its name, what was expected, what was found.
    pub fn fault(&self) -> Option<(String, &'static str, String)> {
        let numbers = [("bias", self.bias), ("sigma.bias", self.sigma.bias)];
        for (field, found) in numbers {
            if !found.is_finite() {
                return Some((field.into(), "a finite number", found.to_string()));
            }
        }
        // The message says `p_over_25m`.
        if self.bound_m != 25.0 {
            return Some(("bound_m".into(), "25", self.bound_m.to_string()));
        }
        if self.cues.is_empty() || self.cues.len() > 64 {
            return Some(("cues".into(), "1 to 64", self.cues.len().to_string()));
        }
        for (i, cue) in self.cues.iter().enumerate() {
            let finite = [cue.low, cue.high, cue.weight, cue.sigma_weight].iter().all(|v| v.is_finite());
            if !finite || cue.low > cue.high || cue.name.is_empty() {
                return Some((format!("cues[{i}]"), "a name, finite numbers and low <= high", format!("{cue:?}")));
            }
        }
        let Knots { scores, p } = &self.probability;
        let rising = scores.windows(2).all(|w| w[0] < w[1]) && p.windows(2).all(|w| w[0] <= w[1]);
        let finite = scores.iter().all(|s| s.is_finite()) && p.iter().all(|p| (0.0..=1.0).contains(p));
        if scores.len() != p.len() || p.is_empty() || p.len() > 256 || !rising || !finite {
            let expected = "1 to 256 rising scores with as many probabilities that do not fall";
            return Some(("probability".into(), expected, format!("{} scores, {} probabilities", scores.len(), p.len())));
        }
        let Sigma { least_m, most_m, tail999, .. } = self.sigma;
        if !(1e-3..=1e4).contains(&least_m) || !(least_m..=1e4).contains(&most_m) {
            return Some(("sigma.least_m".into(), "0.001 to most_m, at most 10000", format!("{least_m}, {most_m}")));
        }
        if !(GAUSSIAN_TAIL999 - 1e-3..=1e3).contains(&tail999) {
            return Some(("sigma.tail999".into(), "3.7169 (a Gaussian's) to 1000", tail999.to_string()));
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Integrity {
        let cue = |name: &str, transform, weight, sigma_weight| Cue {
            name: name.into(),
            transform,
            low: -5.0,
            high: 5.0,
            weight,
            sigma_weight,
        };
        Integrity {
            data: "a".into(),
            command: "b".into(),
            trials: 10,
            bound_m: 25.0,
            bias: 1.0,
            cues: vec![cue("mass", Transform::Logit, -1.0, 0.0), cue("residual", Transform::Log, 0.5, 1.0)],
            probability: Knots { scores: vec![-2.0, 0.0, 2.0], p: vec![0.01, 0.2, 1.0] },
            sigma: Sigma { bias: 0.0, least_m: 0.5, most_m: 20.0, tail999: 4.0 },
        }
    }

    fn judge(mass: f64, residual: f64) -> Judgement {
        table().judge(&[("mass".to_owned(), mass), ("residual".to_owned(), residual)].into()).unwrap()
    }

    #[test]
    fn probability_falls_with_mass_and_sigma_follows_the_residual() {
        assert!((judge(0.5, 1.0).p_over_bound - 0.6).abs() < 1e-3, "{:?}", judge(0.5, 1.0));
        assert_eq!(judge(1.0, 1.0).p_over_bound, 0.01);
        assert_eq!(judge(0.0, 1e9).p_over_bound, 1.0);
        assert!((judge(0.5, 3.0).sigma_m - 3.0).abs() < 1e-2);
        assert_eq!((judge(0.5, 1e-9).sigma_m, judge(0.5, 1e9).sigma_m), (0.5, 20.0));
    }

    #[test]
    fn a_missing_or_broken_cue_is_not_safe() {
        let missing = table().judge(&[("mass".to_owned(), 1.0)].into()).unwrap_err();
        assert_eq!(missing, MissingCue("residual".into()));
        let nan = table().judge(&[("mass".to_owned(), 1.0), ("residual".to_owned(), f64::NAN)].into());
        assert!(nan.is_err());
    }

    #[test]
    fn tables_that_make_no_sense_are_refused_by_field() {
        assert_eq!(table().fault(), None);
        let fault = |change: fn(&mut Integrity)| {
            let mut table = table();
            change(&mut table);
            table.fault().unwrap().0
        };
        assert_eq!(fault(|t| t.bias = f64::NAN), "bias");
        assert_eq!(fault(|t| t.cues.clear()), "cues");
        assert_eq!(fault(|t| t.cues[1].low = 9.0), "cues[1]");
        assert_eq!(fault(|t| t.probability.p = vec![0.3, 0.2, 1.0]), "probability");
        assert_eq!(fault(|t| t.probability.scores.truncate(1)), "probability");
        assert_eq!(fault(|t| t.sigma.tail999 = 3.0), "sigma.tail999");
        assert_eq!(fault(|t| t.sigma.most_m = 0.1), "sigma.least_m");
    }
}
