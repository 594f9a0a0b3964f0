//! Which prior holds at a given exposure.
//!
//! Rules, all of them about one exposure at time t (stamps may lie before or after it: uncertainty grows either way):
//! 1. The *external* prior is the report nearest to t, grown by `max_speed_mps` x age; older than `max_prior_age_s` it
//!    is stale. A report that echoes one of our fixes is not external.
//! 2. The *own* prior is the own fix, or the echo of one, nearest to t: per-axis sigma at least `own_fix_sigma_m`,
//!    grown alike. It is gone `fall_back_after_s` after the fix, and after `fall_back_after_no_fix` "no fix" in a row.
//! 3. An echo of a fix that was given up (by those "no fix") is as wide as it says and `max_speed_mps` x the time since that
//!    fix: what the estimator knew besides may be no more than that fix. Of a fix that is not remembered an echo counts as one
//!    deep, until the first such loss; an echo of one older than those remembered is refused.
//! 4. The one of 1. and 2. that is nearer to t is taken (at a tie the one that came later), then the other, then 3.: the first
//!    that is not wider than the bundle can search, else the narrowest.
//!
//! Nothing here reads a clock: time is what stamps say. A clock that steps forward costs the priors that it makes stale. One
//! that steps back costs what is stamped later than the first report or fix after it (over a second: less is disorder);
//! until that comes, the age of what is known is the stamps' difference, not the time that passed.

use super::recent::Recent;
use crate::config::TrackSettings;
use crate::geo::LatLon;
use crate::locate::{Answer, NoFix, Prior, PriorSource, Reason, largest_sigma_m};

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
    /// Echoes of fixes given up.
    given_up: Recent<Known>,
    /// Own fixes, to recognise their echoes.
    fixes: Recent<OwnFix>,
    /// Fixes before this one are given up: tracking was lost since. 0: never lost.
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
            given_up: Recent::new(KEPT),
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
    /// echoes a fix of which too little is known.
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
        let Some((fix_stamp_ns, chain)) = self.echoed(seq, stamp_ns) else { return false };
        let given_up = seq < self.believed_from_seq;
        let since_m = if given_up { self.settings.max_speed_mps * age_s(stamp_ns, fix_stamp_ns).abs() } else { 0.0 };
        // An estimator that was told our fix cannot vouch for it: the floor of an own fix holds for its echo too.
        let floor_m = self.settings.own_fix_sigma_m;
        let spread = match spread {
            Spread::SigmaM(m) => Spread::SigmaM(m.max(floor_m) + since_m),
            Spread::RadiusM(m) => Spread::RadiusM(m.max(3.0 * floor_m) + since_m),
        };
        let echo = Known { position, spread, chain: chain.saturating_add(1), fix_stamp_ns, arrival };
        if given_up { &mut self.given_up } else { &mut self.own }.push(stamp_ns, echo);
        true
    }

    /// Exposure and depth of the fix that is echoed at `stamp_ns`. One that is not remembered, of an earlier process say, is
    /// still our own influence; after a loss it may be what led there.
    fn echoed(&self, seq: u64, stamp_ns: i64) -> Option<(i64, u32)> {
        let known = self.fixes.newest_first().find(|(_, fix)| fix.seq == seq).map(|(at, fix)| (at, fix.chain));
        let oldest = self.fixes.newest_first().map(|(_, fix)| fix.seq).min();
        let of_others = oldest.is_none_or(|oldest| seq > oldest) && self.believed_from_seq == 0;
        known.or(of_others.then_some((stamp_ns, 0)))
    }

    /// The prior for a frame exposed at `stamp_ns`: own fix (sigma at least 50 m, grown by speed x age), or after 5
    /// "no fix" or 30 s the last external one, grown by its age. `no_prior` or `stale_prior` where there is none.
    pub fn prior_at(&self, stamp_ns: i64) -> Result<Prior, NoFix> {
        let recent = |at_ns: i64| age_s(stamp_ns, at_ns).abs() <= self.settings.fall_back_after_s;
        let own = self.own.nearest(stamp_ns).filter(|(at, known)| recent(*at) && recent(known.fix_stamp_ns));
        let given_up = self.given_up.nearest(stamp_ns).filter(|(at, _)| recent(*at));
        let mut known: Vec<(i64, &Known)> = self.fresh_external(stamp_ns).into_iter().chain(own).collect();
        known.sort_by_key(|(at, known)| (at.abs_diff(stamp_ns), u64::MAX - known.arrival));
        let priors: Vec<Prior> = known.into_iter().chain(given_up).map(|(at, known)| self.grown(stamp_ns, at, known)).collect();
        let narrow = priors.iter().find(|prior| prior.radius_m <= self.search_radius_m);
        let prior = narrow.or_else(|| priors.iter().min_by(|a, b| a.radius_m.total_cmp(&b.radius_m)));
        prior.copied().ok_or_else(|| self.no_prior_at(stamp_ns))
    }

    fn no_prior_at(&self, stamp_ns: i64) -> NoFix {
        let Some((at_ns, _)) = self.external.nearest(stamp_ns) else {
            return NoFix::new(Reason::NoPrior, "prior: expected one from outside, found none");
        };
        let (most_s, age_s) = (self.settings.max_prior_age_s, age_s(stamp_ns, at_ns).abs());
        NoFix::new(Reason::StalePrior, format!("prior: expected at most {most_s} s from the exposure, found {age_s:.1} s"))
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
            // Where nothing of ours is known there is nothing to lose.
            if self.own.newest_first().next().is_none() {
                return;
            }
            self.no_fix_in_row = self.no_fix_in_row.saturating_add(1);
            if self.no_fix_in_row >= self.settings.fall_back_after_no_fix {
                self.own.clear();
                self.believed_from_seq = seq.saturating_add(1);
                self.no_fix_in_row = 0;
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

#[cfg(test)]
#[path = "tracker_tests.rs"]
mod tests;
