//! Consistency over frames: what no motion explains is held back until another frame agrees, a frozen picture is no news.
//!
//! Rules, each about one answer, in the order in which they are tested:
//! 1. One of the last few pictures again, bit for bit, at another exposure: its fix is that of the first exposure, and its stated
//!    error grows by `max_speed_mps` x the time since; from the `frozen_frames`-th exposure, over `frozen_after_s`, on it is
//!    `held_back`.
//! 2. A fix outside the disc of the external prior nearest in time, grown by its age, is `held_back`, whichever prior led to
//!    it: a chain of own fixes does not outlive what others know. It confirms nothing.
//! 3. A fix further from the published one nearest in time than motion allows is `held_back`; but not where a new external
//!    prior came with it from a source that jumps itself (independent places, a restarted estimator). A source is taken as
//!    continuous where it made a step, and its last `steady_reports` ones were such as the vehicle can fly.
//! 4. A fix that was searched for beyond the bundle's D_C is always held back, 3. or not.
//! 5. What 3. and 4. hold back is published where `confirmations` earlier answers of other ground agree with it: of other
//!    ground, so that one picture does not confirm itself; for a searched one only where agreement by chance is rare. A jump
//!    is published as well where time alone lies between (`confirm_after_s`: a vehicle may hover), but no calibration
//!    covers it, nor what follows until the vehicle is on other ground. What a search found for a vehicle that hovers stays held back.
//!
//! Goes between [`crate::locate::Localizer`] and [`super::Tracker::record`]: what is held back becomes no own prior. No
//! clock: time is what stamps say, in whatever order they come.

use super::recent::Recent;
use super::tracker::age_s;
use crate::config::TrackSettings;
use crate::geo::LatLon;
use crate::locate::{Answer, Fix, NoFix, Prior, PriorSource, Reason, largest_sigma_m};
use sha2::{Digest, Sha256};
use std::collections::VecDeque;

/// Published and held answers kept of each: enough for frames that come out of order.
const KEPT: usize = 16;
/// Pictures remembered: enough for a driver that goes round in its buffers.
const PICTURES: usize = 16;
/// Stamps of one report, computed from its age, differ by rounding only.
const SAME_REPORT_NS: u64 = 1_000;
/// Of a distance, relative.
const ROUNDING: f64 = 1e-9;

/// An external prior, as the frames that used it tell.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Report {
    stamp_ns: i64,
    position: LatLon,
}

/// Where an answer put the vehicle.
#[derive(Debug, Clone, Copy)]
struct Place {
    position: LatLon,
    /// Of its worst axis, metres.
    sigma_m: f64,
    /// The newest external report by then.
    report: Option<Report>,
}

/// A picture, and since when it is seen.
#[derive(Debug, Clone)]
struct Picture {
    digest: [u8; 32],
    first_stamp_ns: i64,
    last_stamp_ns: i64,
    /// At different exposures.
    count: u32,
    /// Of its first exposure that was answered: what attitude a later one states is not that of the picture.
    fix: Option<Fix>,
}

/// Checks answers against those before them.
#[derive(Debug, Clone)]
pub struct Guard {
    settings: TrackSettings,
    enabled: bool,
    published: Recent<Place>,
    held: Recent<Place>,
    /// Where a jump was published that time alone confirmed, until the vehicle is on other ground.
    doubtful: Option<LatLon>,
    /// External reports in the order of their stamps, the last few.
    reports: VecDeque<Report>,
    /// The last to be seen at the back.
    pictures: VecDeque<Picture>,
}

impl Guard {
    /// Nothing seen yet. Not `enabled` (gates off): nothing is held back.
    pub fn new(settings: TrackSettings, enabled: bool) -> Self {
        let (published, held) = (Recent::new(KEPT), Recent::new(KEPT));
        Self { settings, enabled, published, held, doubtful: None, reports: VecDeque::new(), pictures: VecDeque::new() }
    }

    /// Judges the answer for a frame exposed at `stamp_ns` (`frame`: its bytes as they came, where it has any; `external`:
    /// [`super::Tracker::external_at`] by then): a fix may become `held_back`, or its stated error wider.
    pub fn judge(&mut self, stamp_ns: i64, frame: Option<&[u8]>, external: Option<&Prior>, answer: &mut Answer) {
        if !self.enabled {
            return;
        }
        let (repeats, picture_age_s) = self.look(stamp_ns, frame);
        let report = self.note(stamp_ns, answer.prior.as_ref());
        let Ok(fix) = &mut answer.outcome else { return };
        if repeats >= self.settings.frozen_frames && picture_age_s >= self.settings.frozen_after_s {
            let detail = format!(
                "frame: expected a new picture, found the same one bit for bit at {repeats} exposures over {picture_age_s:.3} s: \
                 the camera is frozen"
            );
            answer.outcome = Err(NoFix::new(Reason::HeldBack, detail));
            return;
        }
        if let Some(picture) = self.pictures.back_mut().filter(|_| frame.is_some()) {
            let first = picture.fix.get_or_insert_with(|| fix.clone());
            if picture_age_s > 0.0 {
                fix.position = first.position;
                fix.covariance_enu_m2 = first.covariance_enu_m2;
                (fix.radius95_m, fix.radius999_m) = (first.radius95_m, first.radius999_m);
            }
        }
        if let Some(detail) = external.and_then(|external| contradicts(external, fix.position)) {
            answer.outcome = Err(NoFix::new(Reason::HeldBack, detail));
            return;
        }
        if picture_age_s > 0.0 {
            widen(fix, self.settings.max_speed_mps * picture_age_s);
            answer.evidence.insert("picture_age_s".to_owned(), picture_age_s);
        }
        let position = fix.position;
        let place = Place { position, sigma_m: largest_sigma_m(&fix.covariance_enu_m2), report: self.reports.back().copied() };
        let searched_m = answer.searched.then_some(answer.prior.map_or(0.0, |prior| prior.radius_m));
        match self.weigh(stamp_ns, &place, report, searched_m) {
            Ok(confirmed) => {
                let settled_m = self.settings.confirm_distance_m;
                let since = self.doubtful.filter(|since| since.distance_m(position) < settled_m);
                self.doubtful = if confirmed { since } else { Some(position) };
                if self.doubtful.is_some() {
                    (fix.calibrated, fix.p_over_25m) = (false, None);
                }
                // What the track went past confirms nothing any more.
                self.held.clear();
                self.published.push(stamp_ns, place);
            }
            Err(detail) => {
                self.held.push(stamp_ns, place);
                answer.outcome = Err(NoFix::new(Reason::HeldBack, detail));
            }
        }
    }

    /// Published, and whether more than time speaks for it; or the words why not.
    fn weigh(&self, stamp_ns: i64, place: &Place, new: Option<Report>, searched_m: Option<f64>) -> Result<bool, String> {
        let jump = self.unexplained(stamp_ns, place, new);
        if jump.is_none() && searched_m.is_none() {
            return Ok(true);
        }
        // An older fix says nothing for a jump that the nearest one speaks against.
        let published = self.published.nearest(stamp_ns).filter(|_| jump.is_none());
        let agreeing = |after_s: f64| self.agreeing(stamp_ns, place, published, searched_m, after_s);
        let (agreed, needed) = (agreeing(f64::INFINITY), self.settings.confirmations as usize);
        if agreed >= needed {
            return Ok(true);
        }
        if searched_m.is_none() && agreeing(self.settings.confirm_after_s) >= needed {
            return Ok(false);
        }
        let what = jump.unwrap_or_else(|| "position found by a search".to_owned());
        Err(format!("{what}; expected {needed} earlier answers of other ground that agree, found {agreed}"))
    }

    /// What motion from the published fix nearest in time does not explain, nor a new external report.
    fn unexplained(&self, stamp_ns: i64, place: &Place, new: Option<Report>) -> Option<String> {
        let (at_ns, last) = self.published.nearest(stamp_ns)?;
        let distance_m = last.position.distance_m(place.position);
        let reach_m = self.reach_m(stamp_ns, place, at_ns, last);
        if distance_m <= reach_m {
            return None;
        }
        let newer = new.is_some_and(|new| last.report.is_none_or(|old| new.stamp_ns > old.stamp_ns && !same(&new, &old)));
        if newer && !self.source_is_continuous() {
            return None;
        }
        let age_s = age_s(stamp_ns, at_ns);
        Some(format!("distance from the fix {age_s:.2} s before: expected at most {reach_m:.1} m, found {distance_m:.1} m"))
    }

    /// How many earlier answers, held back or `published`, agree, each of other ground than this one and than the others, or
    /// `after_s` from them.
    fn agreeing(
        &self,
        stamp_ns: i64,
        place: &Place,
        published: Option<(i64, &Place)>,
        searched_m: Option<f64>,
        after_s: f64,
    ) -> usize {
        let settings = &self.settings;
        let other_ground = |(a_ns, a): (i64, &Place), (b_ns, b): (i64, &Place)| {
            age_s(a_ns, b_ns).abs() >= after_s || a.position.distance_m(b.position) >= settings.confirm_distance_m
        };
        let mut counted: Vec<(i64, &Place)> = Vec::new();
        for (at_ns, earlier) in self.held.newest_first().chain(published) {
            let reach_m = self.reach_m(stamp_ns, place, at_ns, earlier);
            let agrees = age_s(stamp_ns, at_ns).abs() <= settings.confirm_within_s
                && earlier.position.distance_m(place.position) <= reach_m
                && searched_m.is_none_or(|radius_m| reach_m <= settings.max_agreement_share * radius_m)
                && other_ground((stamp_ns, place), (at_ns, earlier))
                && counted.iter().all(|other| other_ground(*other, (at_ns, earlier)));
            if agrees {
                counted.push((at_ns, earlier));
            }
        }
        counted.len()
    }

    /// How far two answers may lie apart: motion, 3 sigma of both, slack.
    fn reach_m(&self, a_ns: i64, a: &Place, b_ns: i64, b: &Place) -> f64 {
        let settings = &self.settings;
        settings.max_speed_mps * age_s(a_ns, b_ns).abs() + 3.0 * (a.sigma_m + b.sigma_m) + settings.jump_slack_m
    }

    /// Remembers the picture; at how many exposures it was seen, and the seconds since the first. Where there is none, what was
    /// seen stays.
    fn look(&mut self, stamp_ns: i64, frame: Option<&[u8]>) -> (u32, f64) {
        let Some(bytes) = frame else { return (0, 0.0) };
        let digest: [u8; 32] = Sha256::digest(bytes).into();
        let known = self.pictures.iter().position(|seen| seen.digest == digest).and_then(|i| self.pictures.remove(i));
        let mut seen =
            known.unwrap_or(Picture { digest, first_stamp_ns: stamp_ns, last_stamp_ns: stamp_ns, count: 1, fix: None });
        // One exposure sent twice is no frozen camera.
        if seen.last_stamp_ns != stamp_ns {
            seen.count = seen.count.saturating_add(1);
            seen.last_stamp_ns = stamp_ns;
        }
        let count = if seen.first_stamp_ns == stamp_ns { 1 } else { seen.count };
        let age_s = age_s(stamp_ns, seen.first_stamp_ns).abs();
        self.pictures.push_back(seen);
        if self.pictures.len() > PICTURES {
            self.pictures.pop_front();
        }
        (count, age_s)
    }

    /// Remembers the external report that a prior rests on, and gives it.
    fn note(&mut self, stamp_ns: i64, prior: Option<&Prior>) -> Option<Report> {
        let prior = prior.filter(|prior| prior.source == PriorSource::External)?;
        let age_ns = (prior.age_s.unwrap_or(0.0) * 1e9).round() as i64;
        let report = Report { stamp_ns: stamp_ns.saturating_sub(age_ns), position: prior.position };
        match self.reports.back() {
            Some(last) if same(last, &report) => {}
            // A frame out of order, with what held for it.
            Some(last) if report.stamp_ns <= last.stamp_ns && !self.is_past(last, &report) => {}
            last => {
                if last.is_some_and(|last| report.stamp_ns <= last.stamp_ns) {
                    self.reports.clear();
                }
                self.reports.push_back(report);
                while self.reports.len() > self.settings.steady_reports as usize + 1 {
                    self.reports.pop_front();
                }
            }
        }
        Some(report)
    }

    /// So long before that a clock must have stepped.
    fn is_past(&self, last: &Report, report: &Report) -> bool {
        age_s(last.stamp_ns, report.stamp_ns) > self.settings.max_prior_age_s
    }

    /// Whether the external priors moved as a vehicle does, over the last `steady_reports` steps or as many as there are.
    fn source_is_continuous(&self) -> bool {
        let mut steps = self.reports.iter().zip(self.reports.iter().skip(1));
        let flyable = |(a, b): (&Report, &Report)| {
            let reach_m = self.settings.max_speed_mps * age_s(b.stamp_ns, a.stamp_ns).abs() + self.settings.jump_slack_m;
            a.position.distance_m(b.position) <= reach_m
        };
        self.reports.len() > 1 && steps.all(flyable)
    }
}

/// The words where a fix lies outside what an external prior allows.
fn contradicts(external: &Prior, position: LatLon) -> Option<String> {
    let (radius_m, distance_m) = (external.radius_m, external.position.distance_m(position));
    let within = distance_m <= radius_m * (1.0 + ROUNDING);
    let age_s = external.age_s.unwrap_or(0.0);
    (!within).then(|| {
        format!(
            "distance from the external prior of {age_s:.2} s before: expected at most {radius_m:.1} m, found {distance_m:.1} m"
        )
    })
}

/// Whether two are one report.
fn same(a: &Report, b: &Report) -> bool {
    a.position == b.position && a.stamp_ns.abs_diff(b.stamp_ns) <= SAME_REPORT_NS
}

/// The stated error where the vehicle may have moved on by `by_m`, whichever way. No calibration covers that.
fn widen(fix: &mut Fix, by_m: f64) {
    let [[ee, _], [_, nn]] = &mut fix.covariance_enu_m2;
    *ee += by_m * by_m;
    *nn += by_m * by_m;
    fix.radius95_m += by_m;
    fix.radius999_m += by_m;
    fix.calibrated = false;
    fix.p_over_25m = None;
}

#[cfg(test)]
#[path = "guard_tests.rs"]
mod tests;
