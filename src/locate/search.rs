//! A fix from a prior that is wider than the largest D_C: hierarchical, global then local (the paper's future work).
//!
//! 1. The best places of the whole disc: where the bundle's map features belong to the map, by one dense correlation
//!    ([`Region`]); else every place of a lattice of overlapping windows, nearest first.
//! 2. Each of them through [`Localizer::locate`] with a disc round it: gates, cues and error budget are those of any answer.
//! 3. One of them, or none ([`choose`]). What is found so is marked `searched` and not `calibrated`: that it was the best
//!    of so many is not in the calibration.
//!
//! A search that is stopped half-way gives `deadline`, never the best so far: a rival may lie in what was not seen. What
//! was encoded of the map is kept, so that the next frame gets further.

use super::gates::{judge_distance, judge_frame};
use super::hypotheses::{Hypothesis, hypotheses};
use super::inputs::FrameView;
use super::pair::Steps;
use super::region::{BLOCK_CELLS, Disc, Place, Region, Sight, features_belong_to_the_map, peaks, turned};
use super::{Answer, Evidence, Latency, Localizer, NoFix, Prior, Query, Reason, Seen};
use crate::config::SearchSettings;
use crate::geo::{Enu, LatLon};
use crate::model::StageManifest;

/// Two answers nearer than this are the same place, metres: the bound of a wrong fix.
const SAME_PLACE_M: f64 = 50.0;
/// A place whose logit in the first pass is this much lower than the best one's is no rival and is not looked at: a window
/// costs more than the region. What the hypotheses left out add to a logit (`peak_logit` over `search_logit`) is less:
/// 10.5 at most over 30 frames with yaw within 5 degrees and scale within 5 %.
const NEGLIGIBLE: f64 = 14.0;
/// A refused place so much heavier than the best accepted one is a rival.
const OUTWEIGHS: f64 = 2.0;
/// Windows of a sweep.
const MAX_WINDOWS: usize = 4096;

/// Searches regions with one bundle.
pub struct Searcher {
    settings: SearchSettings,
    /// None where features do not belong to the map: then windows are swept.
    region: Option<Region>,
}

/// A disc to look at.
struct Spot {
    position: LatLon,
    radius_m: f64,
    /// Share of the region's posterior and logit in the first pass, where one was made.
    first_pass: Option<[f64; 2]>,
}

/// Where to look closely, best first, and what is known of it.
struct Spots {
    discs: Vec<Spot>,
    evidence: Evidence,
}

impl Searcher {
    /// For this bundle; tries whether its map features belong to the map.
    pub fn new(localizer: &mut Localizer, settings: SearchSettings) -> Self {
        // The windows of all places stay encoded from frame to frame, beside that of the prior.
        localizer.keep_windows(settings.candidates as usize + 1);
        let (bundle, _, gates, _) = localizer.parts();
        let capacity = settings.max_features_mib.saturating_mul(1 << 20);
        let dense = features_belong_to_the_map(bundle);
        let region = dense.then(|| Region::new(BLOCK_CELLS, capacity, gates.min_map_valid));
        tracing::info!(bundle = bundle.manifest.name, dense, max_radius_m = settings.max_radius_m, "search over a region");
        Self { settings, region }
    }

    /// Widest disc, metres.
    pub fn max_radius_m(&self) -> f64 {
        self.settings.max_radius_m
    }

    /// `dense` or `sweep`.
    pub fn kind(&self) -> &'static str {
        if self.region.is_some() { "dense" } else { "sweep" }
    }

    /// Tiles of map encoded so far.
    pub fn tiles_encoded(&self) -> u64 {
        self.region.as_ref().map_or(0, Region::encodes)
    }

    /// Searches the whole disc of the query's prior.
    pub fn search(&mut self, localizer: &mut Localizer, query: &Query<'_>, go_on: &dyn Fn() -> bool) -> (Answer, Seen) {
        let (mut steps, mut total) = (Steps::start(), Steps::start());
        let (mut answer, seen) = match self.spots(localizer, query, go_on, &mut steps) {
            Ok((prior, spots)) => look_closely(localizer, query, &prior, spots, self.settings.max_second, go_on),
            Err(no_fix) => (no_answer(localizer, query.prior.as_ref().ok().copied(), no_fix), Seen::default()),
        };
        steps.done("search_refine");
        total.done("total");
        answer.searched = true;
        answer.latency_ms = Latency::new();
        for (name, ms) in steps.taken.iter().chain(&total.taken) {
            *answer.latency_ms.entry((*name).to_owned()).or_insert(0.0) += ms;
        }
        (answer, seen)
    }

    fn spots(
        &mut self,
        localizer: &mut Localizer,
        query: &Query<'_>,
        go_on: &dyn Fn() -> bool,
        steps: &mut Steps,
    ) -> Result<(Prior, Spots), NoFix> {
        let prior = query.prior.clone()?;
        let (frame, _) = localizer.read_frame(query, steps)?;
        let manifest = &localizer.bundle().manifest;
        let scale = frame.m_per_px / manifest.m_per_px;
        let reach_m = scale * manifest.search_radius_m;
        localizer.judge_map_reach(&prior, scale)?;
        let view = FrameView { size_px: frame.size_px, gray: &frame.pixels, seen: &frame.valid };
        let mut evidence = Evidence::new();
        let (bundle, map, gates, _) = localizer.parts();
        judge_frame(&view, gates, &mut evidence)?;
        steps.done("search_frame");
        let Some(region) = &mut self.region else {
            let discs = lattice(&prior, reach_m)?;
            evidence.insert("search_km2".into(), discs.len() as f64 * 2.0 * reach_m * reach_m / 1e6);
            return Ok((prior, Spots { discs, evidence }));
        };
        let StageManifest::Correlation(stage) = &bundle.manifest.coarse else {
            return Err(NoFix::new(Reason::NonFinite, "search: expected a correlation stage, found another"));
        };
        let radius_cells = stage.subcell_radius as usize;
        let tried = hypotheses(stage, query.pose.yaw_deg.is_none()).map(|all| thinned(&all)).ok_or_else(|| {
            NoFix::new(Reason::BadFrame, "yaw_deg: expected a known yaw (the bundle states no step), found none")
        })?;
        let middle = (frame.size_px as f64 - 1.0) / 2.0;
        let vehicle_m = [frame.vehicle_px.0 - middle, frame.vehicle_px.1 - middle].map(|px| px * frame.m_per_px);
        let disc = Disc { centre: prior.position, radius_m: prior.radius_m, vehicle_m };
        let sight = Sight { frame: &view, scale, hypotheses: &tried };
        let found = region.correlate(bundle, map, &sight, &disc, go_on)?;
        steps.done("search_correlate");
        let (layout, planes) = found.ok_or_else(|| stopped("the region was not seen to its end"))?;
        // Half of D_C: the windows then lie on a lattice, and the next frame finds them encoded.
        let near_m = reach_m / 2.0;
        let peaks = peaks(&planes, &layout, self.settings.candidates as usize, near_m, radius_cells);
        let place = |place: &Place| {
            let spec = planes.get(place.plane)?.spec;
            let [x, y] = place.shift.map(|d| layout.middle_px(d as f64));
            let vehicle = turned(vehicle_m, tried.get(place.hypothesis)?);
            let at = spec.to_lat_lon(layout.tile_px(), x + vehicle[0] / layout.m_per_px, y + vehicle[1] / layout.m_per_px);
            Some(Spot {
                position: LatLon::new(at.lat_deg, at.lon_deg)?,
                radius_m: near_m,
                first_pass: Some([place.mass, place.logit]),
            })
        };
        let first = peaks.places.first().map_or(0.0, |first| first.logit);
        let heavy = peaks.places.iter().filter(|place| place.logit >= first - NEGLIGIBLE);
        let discs: Vec<Spot> = heavy.filter_map(place).collect();
        if discs.is_empty() {
            return Err(NoFix::new(Reason::OffMap, "search: expected room for the frame on the map in the disc, found none"));
        }
        evidence.insert("search_km2".into(), peaks.searched_km2);
        steps.done("search_peaks");
        Ok((prior, Spots { discs, evidence }))
    }
}

/// Hypotheses of the first pass: the scale nearest to 1, every second rotation. What is left out has a neighbour that is
/// not; all of them are tried when places are looked at closely.
fn thinned(all: &[Hypothesis]) -> Vec<Hypothesis> {
    let off = |h: &Hypothesis| h.scale.ln().abs();
    let least = all.iter().map(off).fold(f64::INFINITY, f64::min);
    let mut of_scale: Vec<Hypothesis> = all.iter().copied().filter(|h| off(h) <= least).collect();
    of_scale.sort_by(|a, b| a.rotation_deg.total_cmp(&b.rotation_deg));
    of_scale.dedup();
    of_scale.into_iter().step_by(2).collect()
}

/// Discs of radius D_C whose inscribed squares cover the prior's disc, nearest first.
fn lattice(prior: &Prior, reach_m: f64) -> Result<Vec<Spot>, NoFix> {
    let step_m = reach_m * std::f64::consts::SQRT_2;
    let n = (prior.radius_m / step_m).ceil().max(0.0);
    if !((2.0 * n + 1.0).powi(2) <= MAX_WINDOWS as f64) {
        let found = (2.0 * n + 1.0).powi(2);
        let detail = format!("sweep: expected at most {MAX_WINDOWS} windows, found {found}");
        return Err(NoFix::new(Reason::PriorTooWide, detail));
    }
    let n = n as i64;
    let mut offsets: Vec<Enu> = (-n..=n)
        .flat_map(|y| (-n..=n).map(move |x| Enu { east_m: x as f64 * step_m, north_m: y as f64 * step_m }))
        .filter(|at| at.east_m.hypot(at.north_m) <= prior.radius_m + reach_m)
        .collect();
    offsets.sort_by(|a, b| a.east_m.hypot(a.north_m).total_cmp(&b.east_m.hypot(b.north_m)));
    Ok(offsets.into_iter().map(|at| Spot { position: prior.position.offset(at), radius_m: reach_m, first_pass: None }).collect())
}

/// A place that was looked at closely.
struct Tried {
    answer: Answer,
    /// Logarithm of its weight: the posterior's mass there under all hypotheses, not normalised, and so comparable from
    /// place to place. None of a bundle that has no such number.
    log_mass: Option<f64>,
    first_pass: Option<[f64; 2]>,
}

impl Tried {
    fn accepted(&self) -> bool {
        self.answer.outcome.is_ok()
    }
    /// Accepted before not, then by weight.
    fn beats(&self, other: &Self) -> bool {
        let rank = |t: &Self| (t.accepted(), t.log_mass.unwrap_or(0.0));
        let ((a, x), (b, y)) = (rank(self), rank(other));
        (a && !b) || (a == b && x > y)
    }
}

fn look_closely(
    localizer: &mut Localizer,
    query: &Query<'_>,
    prior: &Prior,
    spots: Spots,
    max_second: f64,
    go_on: &dyn Fn() -> bool,
) -> (Answer, Seen) {
    let (enabled, min_mass) = {
        let (_, _, gates, _) = localizer.parts();
        (gates.enabled, gates.min_peak_mass)
    };
    let mut tried: Vec<Tried> = Vec::new();
    let mut best: Option<(usize, Seen)> = None;
    let count = spots.discs.len();
    for Spot { position, radius_m, first_pass } in spots.discs {
        if !go_on() {
            let detail = format!("{} of {count} places were looked at", tried.len());
            let mut answer = no_answer(localizer, Some(*prior), stopped(&detail));
            answer.evidence = spots.evidence;
            return (answer, Seen::default());
        }
        let near = Prior { position, radius_m, sigma_m: None, ..*prior };
        let (mut answer, seen) = localizer.locate_in(&Query { prior: Ok(near), ..query.clone() }, true);
        let log_mass = answer.evidence.get("peak_log_mass").copied();
        if let Ok(fix) = &answer.outcome {
            let distance_m = fix.position.distance_m(prior.position);
            if let Err(no_fix) = judge_distance(distance_m, prior.radius_m) {
                close(&mut answer, no_fix, enabled);
            }
        }
        let this = Tried { answer, log_mass, first_pass };
        let better = best.as_ref().and_then(|(i, _)| tried.get(*i)).is_none_or(|other| this.beats(other));
        tried.push(this);
        if better {
            best = Some((tried.len() - 1, seen));
        }
    }
    let Some((at, seen)) = best else {
        return (no_answer(localizer, Some(*prior), NoFix::new(Reason::OffMap, "search: no place to look at")), Seen::default());
    };
    let second = second(&tried, at);
    let looked_at = tried.len();
    let Tried { mut answer, first_pass, .. } = tried.swap_remove(at);
    for (name, value) in &spots.evidence {
        answer.evidence.insert(name.clone(), *value);
    }
    answer.evidence.insert("search_peaks".into(), looked_at as f64);
    answer.evidence.insert("search_second".into(), second);
    if let Some([share, logit]) = first_pass {
        answer.evidence.insert("search_mass".into(), share);
        answer.evidence.insert("search_logit".into(), logit);
    }
    if let Ok(fix) = &answer.outcome {
        let off = prior.position.enu_to(fix.position);
        answer.evidence.insert("search_east_m".into(), off.east_m);
        answer.evidence.insert("search_north_m".into(), off.north_m);
        answer.evidence.insert("prior_distance_share".into(), off.east_m.hypot(off.north_m) / prior.radius_m.max(1.0));
    }
    if answer.outcome.is_ok()
        && let Err(no_fix) = judge(first_pass.map(|[share, _]| share), second, min_mass, max_second)
    {
        close(&mut answer, no_fix, enabled);
    }
    answer.prior = Some(*prior);
    (answer, seen)
}

/// Weight of the best rival over that of the best place. A rival is another place that every gate accepts; one that a gate
/// refused counts only where it is clearly the heavier: then the map's best match is not the one that is left.
fn second(tried: &[Tried], best: usize) -> f64 {
    let Some(first) = tried.get(best) else { return 0.0 };
    let (Ok(fix), own) = (&first.answer.outcome, first.log_mass.unwrap_or(0.0)) else { return 0.0 };
    let mut most = 0.0f64;
    for (_, other) in tried.iter().enumerate().filter(|(i, _)| *i != best) {
        let weight = (other.log_mass.unwrap_or(0.0) - own).exp();
        let rival = match &other.answer.outcome {
            Ok(theirs) => theirs.position.distance_m(fix.position) > SAME_PLACE_M,
            Err(_) => other.log_mass.is_some() && weight > OUTWEIGHS,
        };
        if rival {
            most = most.max(weight);
        }
    }
    most
}

/// Closes a gate, or notes with gates off that it would have closed.
fn close(answer: &mut Answer, no_fix: NoFix, enabled: bool) {
    if enabled {
        answer.outcome = Err(no_fix);
    } else {
        answer.withheld.get_or_insert(no_fix.reason);
    }
}

/// `low_evidence`, then `ambiguous`, over the whole region: as `gates::judge_evidence` over a disc. Of two places of similar
/// weight the mass is that of both.
fn judge(share: Option<f64>, second: f64, min_mass: f64, max_second: f64) -> Result<(), NoFix> {
    let rivals = if second > max_second { second } else { 0.0 };
    if let Some(share) = share.filter(|share| !(share * (1.0 + rivals) >= min_mass)) {
        let detail = format!("share of the region's posterior: expected at least {min_mass}, found {share:.3}");
        return Err(NoFix::new(Reason::LowEvidence, detail));
    }
    if !(second <= max_second) {
        let detail = format!("second place over the first: expected at most {max_second}, found {second:.3}");
        return Err(NoFix::new(Reason::Ambiguous, detail));
    }
    Ok(())
}

fn stopped(what: &str) -> NoFix {
    NoFix::new(Reason::Deadline, format!("search: expected to end in time, but {what}"))
}

fn no_answer(localizer: &Localizer, prior: Option<Prior>, no_fix: NoFix) -> Answer {
    let bundle = Some(localizer.bundle().manifest.name.clone());
    Answer { bundle, searched: true, ..Answer::bare(Err(no_fix), prior) }
}
