//! An optional track beside the raw fixes: a constant-velocity Kalman filter over published fixes, smoothed over a fixed lag.
//!
//! State: east, north (metres, about the first fix), and their speeds. Motion: white acceleration of `track_accel_mps2`. A fix
//! whose squared innovation, in units of its covariance (2 degrees of freedom), exceeds `track_gate` is left out; after
//! `track_restart_after` in a row, or `fall_back_after_s` without one or back in time, the track begins anew. Each fix gives the state then, and
//! what is known by then of the fix `track_lag_fixes` before it: Rauch, Tung and Striebel's backward pass over those kept.
//!
//! Consecutive fixes share the map's error and part of the tilt's, so their errors do not average out: the covariance here is
//! never below that share. Nothing of this goes back into fixes or priors.
//!
//! Reference: Rauch, Tung & Striebel, AIAA Journal 3(8), 1965; Bar-Shalom et al., Estimation with Applications, ch. 6.

use super::tracker::age_s;
use crate::bus::{FixMessage, LaggedState, TrackMessage};
use crate::config::TrackSettings;
use crate::geo::{Enu, LatLon};
use nalgebra::{Matrix2, Matrix2x4, Matrix4, Vector2, Vector4};
use std::collections::VecDeque;

/// A filtered fix: the state before it (predicted), after it, and the motion that led to it.
#[derive(Debug, Clone)]
struct Step {
    stamp_ns: i64,
    seq: u64,
    motion: Matrix4<f64>,
    predicted: (Vector4<f64>, Matrix4<f64>),
    state: (Vector4<f64>, Matrix4<f64>),
    /// What of the covariance is common to neighbouring fixes, square metres per axis.
    common_m2: f64,
    calibrated: bool,
}

/// The track so far.
#[derive(Debug, Clone)]
pub struct TrackFilter {
    settings: TrackSettings,
    origin: LatLon,
    steps: VecDeque<Step>,
    left_out: u32,
}

impl TrackFilter {
    /// No fix yet.
    pub fn new(settings: TrackSettings) -> Self {
        let origin = LatLon { lat_deg: 0.0, lon_deg: 0.0 };
        Self { settings, origin, steps: VecDeque::new(), left_out: 0 }
    }

    /// Takes an answer; the track's message where it is a fix that the track goes on with. Fixes a little older than the last
    /// are left out.
    pub fn take(&mut self, fix: &FixMessage) -> Option<TrackMessage> {
        let (position, covariance) = (fix.position()?, fix.covariance_enu_m2?);
        let covariance = Matrix2::from(covariance).transpose();
        if !covariance.iter().all(|v| v.is_finite()) || covariance.cholesky().is_none() {
            return None;
        }
        let dt_s = self.steps.back().map(|last| age_s(fix.stamp_ns, last.stamp_ns));
        let innovation = match dt_s {
            Some(dt_s) if dt_s <= 0.0 && -dt_s <= self.settings.fall_back_after_s => return None,
            Some(dt_s) if dt_s > 0.0 && dt_s <= self.settings.fall_back_after_s => self.step(fix, position, &covariance, dt_s),
            _ => None,
        };
        let gated = innovation.as_ref().is_some_and(|(nis, _)| !(*nis <= self.settings.track_gate));
        if gated {
            self.left_out += 1;
            if self.left_out < self.settings.track_restart_after {
                return None;
            }
        }
        self.left_out = 0;
        let nis = match innovation {
            Some((nis, step)) if !gated => {
                self.steps.push_back(step);
                Some(nis)
            }
            _ => {
                self.begin(fix, position, &covariance);
                None
            }
        };
        while self.steps.len() > self.settings.track_lag_fixes as usize + 1 {
            self.steps.pop_front();
        }
        self.message(fix, nis)
    }

    /// A track of one fix: it stands still, give or take `max_speed_mps`.
    fn begin(&mut self, fix: &FixMessage, position: LatLon, covariance: &Matrix2<f64>) {
        self.origin = position;
        self.steps.clear();
        let mut wide = Matrix4::identity() * self.settings.max_speed_mps.powi(2);
        wide.fixed_view_mut::<2, 2>(0, 0).copy_from(covariance);
        let state = (Vector4::zeros(), wide);
        let common_m2 = common_m2(fix, covariance);
        let (stamp_ns, seq, motion, calibrated) = (fix.stamp_ns, fix.seq, Matrix4::identity(), fix.calibrated);
        self.steps.push_back(Step { stamp_ns, seq, motion, predicted: state, state, common_m2, calibrated });
    }

    /// Predicts to the fix and corrects with it; also the squared normalised innovation.
    fn step(&self, fix: &FixMessage, position: LatLon, covariance: &Matrix2<f64>, dt_s: f64) -> Option<(f64, Step)> {
        let (x, p) = self.steps.back()?.state;
        let mut motion = Matrix4::identity();
        (motion[(0, 2)], motion[(1, 3)]) = (dt_s, dt_s);
        // White acceleration: Bar-Shalom, Eq. (6.2.2-12), per axis.
        let q = self.settings.track_accel_mps2.powi(2);
        let mut noise = Matrix4::zeros();
        for axis in 0..2 {
            noise[(axis, axis)] = q * dt_s.powi(3) / 3.0;
            noise[(axis, axis + 2)] = q * dt_s.powi(2) / 2.0;
            noise[(axis + 2, axis)] = noise[(axis, axis + 2)];
            noise[(axis + 2, axis + 2)] = q * dt_s;
        }
        let predicted = (motion * x, motion * p * motion.transpose() + noise);
        let Enu { east_m, north_m } = self.origin.enu_to(position);
        let see = Matrix2x4::identity();
        let innovation = Vector2::new(east_m, north_m) - see * predicted.0;
        let spread = see * predicted.1 * see.transpose() + covariance;
        let inverse = spread.try_inverse()?;
        let gain = predicted.1 * see.transpose() * inverse;
        let keep = Matrix4::identity() - gain * see;
        // Joseph's form stays symmetric and positive.
        let p = keep * predicted.1 * keep.transpose() + gain * covariance * gain.transpose();
        let state = (predicted.0 + gain * innovation, p);
        let common_m2 = common_m2(fix, covariance);
        let nis = (innovation.transpose() * inverse * innovation)[(0, 0)];
        let (stamp_ns, seq, calibrated) = (fix.stamp_ns, fix.seq, fix.calibrated);
        Some((nis, Step { stamp_ns, seq, motion, predicted, state, common_m2, calibrated }))
    }

    /// The oldest fix kept, in the light of all after it.
    fn smoothed(&self) -> Option<(Vector4<f64>, Matrix4<f64>)> {
        let mut later: Option<(&Step, (Vector4<f64>, Matrix4<f64>))> = None;
        for step in self.steps.iter().rev() {
            let state = match later {
                None => step.state,
                Some((next, known)) => {
                    let gain = step.state.1 * next.motion.transpose() * next.predicted.1.try_inverse()?;
                    (
                        step.state.0 + gain * (known.0 - next.predicted.0),
                        step.state.1 + gain * (known.1 - next.predicted.1) * gain.transpose(),
                    )
                }
            };
            later = Some((step, state));
        }
        later.map(|(_, state)| state)
    }

    fn message(&self, fix: &FixMessage, innovation_nees: Option<f64>) -> Option<TrackMessage> {
        let (first, last) = (self.steps.front()?, self.steps.back()?);
        let (now, lagged) = (last.state, self.smoothed()?);
        let position = |x: &Vector4<f64>| self.origin.offset(Enu { east_m: x[0], north_m: x[1] });
        let (at, was) = (position(&now.0), position(&lagged.0));
        Some(TrackMessage {
            stamp_ns: fix.stamp_ns,
            fix_seq: fix.seq,
            lat_deg: at.lat_deg,
            lon_deg: at.lon_deg,
            covariance_enu_m2: with_common(&now.1, last.common_m2),
            velocity_enu_mps: [now.0[2], now.0[3]],
            innovation_nees,
            calibrated: self.steps.iter().all(|step| step.calibrated),
            lagged: LaggedState {
                stamp_ns: first.stamp_ns,
                fix_seq: first.seq,
                lat_deg: was.lat_deg,
                lon_deg: was.lon_deg,
                covariance_enu_m2: with_common(&lagged.1, first.common_m2),
            },
        })
    }
}

/// What neighbouring fixes share, at most what the fix states: the map's error and the tilt's, per axis.
fn common_m2(fix: &FixMessage, covariance: &Matrix2<f64>) -> f64 {
    let shared = ["sigma_map_m", "sigma_tilt_m"].iter().filter_map(|name| fix.evidence.get(*name));
    let shared: f64 = shared.map(|sigma_m| sigma_m * sigma_m).sum();
    shared.min(covariance[(0, 0)]).min(covariance[(1, 1)])
}

/// The position's covariance, no axis below what averaging cannot remove.
fn with_common(p: &Matrix4<f64>, common_m2: f64) -> [[f64; 2]; 2] {
    let raise = (common_m2 - p[(0, 0)].min(p[(1, 1)])).max(0.0);
    [[p[(0, 0)] + raise, p[(0, 1)]], [p[(1, 0)], p[(1, 1)] + raise]]
}

#[cfg(test)]
#[path = "filter_tests.rs"]
mod tests;
