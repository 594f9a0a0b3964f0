//! What a replay is judged by. Every key is always written; what cannot be known is null.
//!
//! Reference: ARCHITECTURE.md, "Recorded flight", `metrics.json`.

use super::format::Row;
use crate::bus::FixMessage;
use crate::geo::{Enu, LatLon};
use crate::homography::Homography;
use crate::locate::Reason;
use serde::Serialize;
use std::collections::BTreeMap;

/// Side of the rectified frame, metres and pixels.
const FRAME_M: f64 = 512.0;

/// Centre errors over the scored fixes, metres; all null where there are none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ErrorSummary {
    /// 50 %.
    pub median: Option<f64>,
    /// Mean.
    pub mean: Option<f64>,
    /// 95 %, linear between order statistics.
    pub p95: Option<f64>,
    /// 99 %.
    pub p99: Option<f64>,
    /// Largest.
    pub max: Option<f64>,
}

/// How long a step took, milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LatencySummary {
    /// 50 %.
    pub median: f64,
    /// 95 %.
    pub p95: f64,
    /// Largest.
    pub max: f64,
}

/// `metrics.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Metrics {
    /// Rows.
    pub frames: usize,
    /// Rows with a fix.
    pub fixes: usize,
    /// fixes / frames; 0 without frames.
    pub coverage: f64,
    /// "No fix" by reason.
    pub no_fix: BTreeMap<Reason, usize>,
    /// Fixes with truth.
    pub scored: usize,
    /// Geodesic distance of fix and truth, metres.
    pub error_m: ErrorSummary,
    /// Fraction of scored above 25 m.
    pub over_25m: Option<f64>,
    /// Fraction of scored above 50 m.
    pub over_50m: Option<f64>,
    /// Mean over four corners of the fitted frame against a 512 m square at the truth turned by truth yaw - yaw.
    pub mace_m: Option<f64>,
    /// By step.
    pub latency_ms: BTreeMap<String, LatencySummary>,
}

/// Collects lines into metrics.
#[derive(Debug, Clone, Default)]
pub struct Tally {
    frames: usize,
    fixes: usize,
    no_fix: BTreeMap<Reason, usize>,
    errors_m: Vec<f64>,
    corners_m: Vec<f64>,
    latency_ms: BTreeMap<String, Vec<f64>>,
}

impl Tally {
    /// Counts one answer. Returns its error, metres, where there is a fix and a truth.
    pub fn add(&mut self, row: &Row, message: &FixMessage) -> Option<f64> {
        self.frames += 1;
        for (step, ms) in &message.latency_ms {
            self.latency_ms.entry(step.clone()).or_default().push(*ms);
        }
        let Some(fix) = message.position() else {
            if let Some(reason) = message.reason {
                *self.no_fix.entry(reason).or_default() += 1;
            }
            return None;
        };
        self.fixes += 1;
        let truth = row.truth?;
        let error_m = fix.distance_m(truth);
        self.errors_m.push(error_m);
        self.corners_m.extend(corner_error_m(row, truth, message));
        Some(error_m)
    }

    /// The metrics so far.
    pub fn metrics(&self) -> Metrics {
        let share_over = |limit: f64| {
            let over = self.errors_m.iter().filter(|e| **e > limit).count();
            (!self.errors_m.is_empty()).then(|| over as f64 / self.errors_m.len() as f64)
        };
        let latency = |values: &Vec<f64>| {
            Some(LatencySummary {
                median: percentile(values, 0.5)?,
                p95: percentile(values, 0.95)?,
                max: percentile(values, 1.0)?,
            })
        };
        Metrics {
            frames: self.frames,
            fixes: self.fixes,
            coverage: if self.frames == 0 { 0.0 } else { self.fixes as f64 / self.frames as f64 },
            no_fix: self.no_fix.clone(),
            scored: self.errors_m.len(),
            error_m: ErrorSummary {
                median: percentile(&self.errors_m, 0.5),
                mean: mean(&self.errors_m),
                p95: percentile(&self.errors_m, 0.95),
                p99: percentile(&self.errors_m, 0.99),
                max: percentile(&self.errors_m, 1.0),
            },
            over_25m: share_over(25.0),
            over_50m: share_over(50.0),
            mace_m: mean(&self.corners_m),
            latency_ms: self.latency_ms.iter().filter_map(|(step, v)| Some((step.clone(), latency(v)?))).collect(),
        }
    }
}

/// Thresholds of `nightfix replay`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Thresholds {
    /// Least coverage.
    pub min_coverage: Option<f64>,
    /// Largest median error, metres.
    pub max_median_m: Option<f64>,
    /// Largest fraction above 50 m.
    pub max_over_50m: Option<f64>,
}

impl Thresholds {
    /// What failed, in words. A threshold asked of a null fails.
    pub fn failures(&self, metrics: &Metrics) -> Vec<String> {
        let most = |name: &str, value: Option<f64>, limit: Option<f64>| {
            let limit = limit?;
            match value {
                Some(value) if value <= limit => None,
                Some(value) => Some(format!("{name}: expected at most {limit}, found {value}")),
                None => Some(format!("{name}: expected at most {limit}, found null: nothing was scored")),
            }
        };
        let coverage = self.min_coverage.filter(|limit| !(metrics.coverage >= *limit));
        coverage
            .map(|limit| format!("coverage: expected at least {limit}, found {}", metrics.coverage))
            .into_iter()
            .chain(most("error_m.median", metrics.error_m.median, self.max_median_m))
            .chain(most("over_50m", metrics.over_50m, self.max_over_50m))
            .collect()
    }
}

/// Mean distance of the fitted frame's four corners from those of the true 512 m square.
///
/// The rectified frame is north-up under the reported yaw; what it shows is turned by truth yaw - reported yaw, so the
/// true square's "up" points that much clockwise from north.
fn corner_error_m(row: &Row, truth: LatLon, message: &FixMessage) -> Option<f64> {
    let (window, homography) = (message.window?, Homography(message.homography?));
    let (sin, cos) = (row.truth_yaw_deg? - row.pose.yaw_deg?).to_radians().sin_cos();
    let centre = LatLon::new(window.lat_deg, window.lon_deg)?;
    let middle = (window.width_m - 1.0) / 2.0;
    let mut sum = 0.0;
    // Corners are outer edges: half a pixel outside the first and the last pixel's centre.
    for (right, up) in [(-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)] {
        let half = FRAME_M / 2.0;
        let [x, y] = homography.apply(half - 0.5 + right * half, half - 0.5 - up * half);
        let found = centre.offset(Enu { east_m: x - middle, north_m: middle - y });
        let (right_m, up_m) = (right * half, up * half);
        let expected = truth.offset(Enu { east_m: right_m * cos + up_m * sin, north_m: up_m * cos - right_m * sin });
        sum += found.distance_m(expected);
    }
    Some(sum / 4.0)
}

/// Linear interpolation between order statistics, as numpy does by default; `None` of nothing.
fn percentile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let place = share * (sorted.len().checked_sub(1)?) as f64;
    let (low, high) = (sorted.get(place.floor() as usize)?, sorted.get(place.ceil() as usize)?);
    Some(low + (high - low) * place.fract())
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

#[cfg(test)]
#[path = "metrics_tests.rs"]
mod tests;
