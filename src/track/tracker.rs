//! Which prior holds at a given exposure.
//!
//! Rules, all of them about one exposure at time t (stamps may lie before or after it: uncertainty grows either way):
//! 1. The *external* prior is the report nearest to t, grown by `max_speed_mps` x age; older than `max_prior_age_s` it
//!    is stale. A report that echoes one of our fixes is not external.
//! 2. The *own* prior is the own fix, or the echo of one, nearest to t: per-axis sigma at least `own_fix_sigma_m`,
//!    grown alike. It is gone `fall_back_after_s` after the fix, and after `fall_back_after_no_fix` "no fix" in a row.
//! 3. Of the two the one nearer to t is taken (at a tie the one that came later); but the other one where the first is
//!    wider than the bundle can search and the other is not.
//!
//! Nothing here reads a clock: time is what stamps say. A clock that steps forward costs the priors that it makes stale. One
//! that steps back costs what is stamped later than the first report or fix after it (over a second: less is disorder);
//! until that comes, the age of what is known is the stamps' difference, not the time that passed.

use super::recent::Recent;
use crate::config::TrackSettings;
use crate::geo::LatLon;
use crate::locate::{Answer, NoFix, Prior, PriorSource, Reason};

/// External reports, own fixes and echoes kept of each: enough for frames that come out of order.
const KEPT: usize = 64;

/// How wide a reported prior is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Spread {
    /// 1-sigma per axis, metres.
    SigmaM(f64),
    /// A hard bound, metres.
    RadiusM(f64),
}

/// A prior as reported from outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PriorReport {
    /// When it held, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Where.
    pub position: LatLon,
    /// How wide.
    pub spread: Spread,
    /// The sequence number of our fix that it echoes, where it does.
    pub fix_seq: Option<u64>,
}

/// Something known about where the vehicle was.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Known {
    position: LatLon,
    spread: Spread,
    /// Own fixes deep; 0 is external.
    chain: u32,
    /// Exposure of the own fix it rests on; of an external prior, its own stamp.
    fix_stamp_ns: i64,
    /// Counts everything that was learnt: tells which came later.
    arrival: u64,
}

/// What is remembered of an own fix, to recognise its echoes.
#[derive(Debug, Clone, Copy)]
struct OwnFix {
    seq: u64,
    chain: u32,
}

/// Keeps the last external priors and the last own fixes.
#[derive(Debug, Clone)]
pub struct Tracker {
    settings: TrackSettings,
    search_radius_m: f64,
    external: Recent<Known>,
    own: Recent<Known>,
    /// Own fixes whose echoes are believed.
    fixes: Recent<OwnFix>,
    /// Echoes of fixes before this one are not believed: tracking was lost since.
    believed_from_seq: u64,
    no_fix_in_row: u32,
    arrivals: u64,
}

impl Tracker {
    /// Nothing known yet.
    pub fn new(settings: TrackSettings) -> Self {
        Self {
            settings,
            search_radius_m: f64::INFINITY,
            external: Recent::new(KEPT),
            own: Recent::new(KEPT),
            fixes: Recent::new(KEPT),
            believed_from_seq: 0,
            no_fix_in_row: 0,
            arrivals: 0,
        }
    }

    /// States the bundle's D_C, metres: of two priors, one that is wider gives way to one that is not.
    pub fn with_search_radius_m(mut self, search_radius_m: f64) -> Self {
        self.search_radius_m = search_radius_m;
        self
    }

    /// A prior came from outside. False, and nothing learnt, where a number is not finite or out of range, or where it
    /// echoes a fix that is no longer believed.
    pub fn report(&mut self, prior: PriorReport) -> bool {
        let PriorReport { stamp_ns, position, spread, fix_seq } = prior;
        let width_m = match spread {
            Spread::SigmaM(m) | Spread::RadiusM(m) => m,
        };
        if LatLon::new(position.lat_deg, position.lon_deg).is_none() || !width_m.is_finite() || width_m <= 0.0 {
            return false;
        }
        self.arrivals += 1;
        let arrival = self.arrivals;
        let Some(seq) = fix_seq else {
            self.external.push(stamp_ns, Known { position, spread, chain: 0, fix_stamp_ns: stamp_ns, arrival });
            return true;
        };
        if seq < self.believed_from_seq {
            return false;
        }
        // The echo of a fix we do not remember (of an earlier process, say) is still our own influence: how deep is
        // unknown, so it counts as one.
        let fix = self.fixes.newest_first().find(|(_, fix)| fix.seq == seq).map(|(stamp_ns, fix)| (stamp_ns, fix.chain));
        let (fix_stamp_ns, chain) = fix.unwrap_or((stamp_ns, 0));
        // An estimator that was told our fix cannot vouch for it: the floor of an own fix holds for its echo too.
        let floor_m = self.settings.own_fix_sigma_m;
        let spread = match spread {
            Spread::SigmaM(m) => Spread::SigmaM(m.max(floor_m)),
            Spread::RadiusM(m) => Spread::RadiusM(m.max(3.0 * floor_m)),
        };
        self.own.push(stamp_ns, Known { position, spread, chain: chain.saturating_add(1), fix_stamp_ns, arrival });
        true
    }

    /// The prior for a frame exposed at `stamp_ns`: own fix (sigma at least 50 m, grown by speed x age), or after 5
    /// "no fix" or 30 s the last external one, grown by its age. `no_prior` or `stale_prior` where there is none.
    pub fn prior_at(&self, stamp_ns: i64) -> Result<Prior, NoFix> {
        let nearest_external = self.external.nearest(stamp_ns);
        let external = self.fresh_external(stamp_ns);
        let own = self
            .own
            .nearest(stamp_ns)
            .filter(|(_, known)| age_s(stamp_ns, known.fix_stamp_ns).abs() <= self.settings.fall_back_after_s)
            .filter(|(at, _)| age_s(stamp_ns, *at).abs() <= self.settings.fall_back_after_s);
        let external = external.map(|(at, known)| (at, known.arrival, self.grown(stamp_ns, at, known)));
        let own = own.map(|(at, known)| (at, known.arrival, self.grown(stamp_ns, at, known)));
        match (external, own) {
            (Some(a), Some(b)) => {
                let nearer = |(at, arrival, _): (i64, u64, Prior)| (at.abs_diff(stamp_ns), u64::MAX - arrival);
                let (first, other) = if nearer(a) < nearer(b) { (a.2, b.2) } else { (b.2, a.2) };
                let too_wide = first.radius_m > self.search_radius_m && other.radius_m <= self.search_radius_m;
                Ok(if too_wide { other } else { first })
            }
            (Some((_, _, prior)), None) | (None, Some((_, _, prior))) => Ok(prior),
            (None, None) => Err(match nearest_external {
                Some((at, _)) => NoFix {
                    reason: Reason::StalePrior,
                    detail: format!(
                        "prior: expected at most {} s from the exposure, found {:.1} s",
                        self.settings.max_prior_age_s,
                        age_s(stamp_ns, at).abs()
                    ),
                },
                None => NoFix { reason: Reason::NoPrior, detail: "prior: expected one from outside, found none".to_owned() },
            }),
        }
    }

    /// The external prior nearest to `stamp_ns`, grown to it, where it is not stale: no fix may lie outside its disc, whichever
    /// prior led to the fix.
    pub fn external_at(&self, stamp_ns: i64) -> Option<Prior> {
        self.fresh_external(stamp_ns).map(|(at, known)| self.grown(stamp_ns, at, known))
    }

    fn fresh_external(&self, stamp_ns: i64) -> Option<(i64, &Known)> {
        self.external.nearest(stamp_ns).filter(|(at, _)| age_s(stamp_ns, *at).abs() <= self.settings.max_prior_age_s)
    }

    /// An answer was given for a frame exposed at `stamp_ns`, with message number `seq`.
    pub fn record(&mut self, stamp_ns: i64, seq: u64, answer: &Answer) {
        let Ok(fix) = &answer.outcome else {
            self.no_fix_in_row = self.no_fix_in_row.saturating_add(1);
            if self.no_fix_in_row >= self.settings.fall_back_after_no_fix {
                self.own.clear();
                self.fixes.clear();
                self.believed_from_seq = seq.saturating_add(1);
            }
            return;
        };
        self.no_fix_in_row = 0;
        let sigma_m = largest_sigma_m(&fix.covariance_enu_m2);
        let position = fix.position;
        if !sigma_m.is_finite() || LatLon::new(position.lat_deg, position.lon_deg).is_none() {
            return;
        }
        let chain = answer.prior.map_or(0, |prior| prior.chain).saturating_add(1);
        self.arrivals += 1;
        let spread = Spread::SigmaM(sigma_m.max(self.settings.own_fix_sigma_m));
        self.own.push(stamp_ns, Known { position, spread, chain, fix_stamp_ns: stamp_ns, arrival: self.arrivals });
        self.fixes.push(stamp_ns, OwnFix { seq, chain });
    }

    /// What is known, grown to the exposure.
    fn grown(&self, stamp_ns: i64, at_ns: i64, known: &Known) -> Prior {
        let age_s = age_s(stamp_ns, at_ns);
        let growth_m = self.settings.max_speed_mps * age_s.abs();
        let (radius_m, sigma_m) = match known.spread {
            Spread::SigmaM(m) => (3.0 * (m + growth_m), Some(m + growth_m)),
            Spread::RadiusM(m) => (m + growth_m, None),
        };
        let source = if known.chain == 0 { PriorSource::External } else { PriorSource::OwnFix };
        Prior { position: known.position, radius_m, sigma_m, source, chain: known.chain, age_s: Some(age_s) }
    }
}

/// Seconds from `from_ns` to `to_ns`.
pub(super) fn age_s(to_ns: i64, from_ns: i64) -> f64 {
    (i128::from(to_ns) - i128::from(from_ns)) as f64 / 1e9
}

/// Square root of the larger eigenvalue of a covariance, metres: no axis is worse.
pub(super) fn largest_sigma_m(covariance_m2: &[[f64; 2]; 2]) -> f64 {
    let [[ee, en], [_, nn]] = *covariance_m2;
    let mean = 0.5 * (ee + nn);
    (mean + (0.5 * (ee - nn)).hypot(en)).sqrt()
}

#[cfg(test)]
#[path = "tracker_tests.rs"]
mod tests;
