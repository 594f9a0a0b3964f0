//! The localizer: a bundle, a map and settings; queries in, answers out.

use super::cues;
use super::gates::{judge_distance, judge_evidence, judge_frame, judge_map, judge_probability, judge_quad, map_valid_share};
use super::inputs::{FrameView, WindowView};
use super::pair::{PairError, PairMatch, Search, Steps, match_pair, similarity_of};
use super::scaled::{affine_at_metres, homography_at_metres, inner_affine, scale_for};
use super::windows::{WindowError, Windows, window_centre};
use super::{Answer, Evidence, Fix, NoFix, Prior, Query, Reason, StageName, WindowInfo, budget};
use crate::config::{BudgetSettings, GateSettings};
use crate::geo::LatLon;
use crate::map::{MapCache, MapError, Window, WindowSpec};
use crate::model::{Bundle, Judgement, StageManifest};
use crate::thermal::{Pose, Rectified, decode, rectify, tone_map};
use std::sync::Arc;

/// Pixels of the map over those of the window up to which a calibration holds.
const MAX_CALIBRATED_PX: f64 = 2.0;
/// Share of the frame's square that must have been seen for a calibration to hold.
const MIN_CALIBRATED_SEEN: f64 = 0.9;
/// Tilt of the camera up to which a calibration holds, degrees.
const MAX_CALIBRATED_TILT_DEG: f64 = 10.0;
/// R may exceed D_C by rounding, no more.
pub(super) const RADIUS_SLACK: f64 = 1e-6;

/// What can be wrong when a localizer is put together (never while it answers).
#[derive(Debug, thiserror::Error)]
pub enum LocateError {
    /// The bundle states something this version cannot serve.
    #[error("bundle `{bundle}`: {field}: expected {expected}, found {found}")]
    Bundle {
        /// Bundle name.
        bundle: String,
        /// Manifest field.
        field: &'static str,
        /// What is served.
        expected: String,
        /// What it says.
        found: String,
    },
    /// A gate or an error term is not a number that makes sense.
    #[error("{field}: expected {expected}, found {found}")]
    Setting {
        /// Configuration key.
        field: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: f64,
    },
    /// The map.
    #[error(transparent)]
    Map(#[from] MapError),
}

/// What was looked at on the way to an answer, for pictures.
#[derive(Debug, Clone, Default)]
pub struct Seen {
    /// The window with its margin, where one was made.
    pub window: Option<Arc<Window>>,
    /// The rectified frame, where there is one.
    pub frame: Option<Rectified>,
}

/// Answers queries about one map with one bundle.
pub struct Localizer {
    bundle: Bundle,
    windows: Windows,
    map_centre: LatLon,
    map_id: (String, String),
    gates: GateSettings,
    budget: BudgetSettings,
}

impl Localizer {
    /// Puts one together. Reads the map once, for its digest.
    pub fn new(bundle: Bundle, map: MapCache, gates: GateSettings, budget: BudgetSettings) -> Result<Self, LocateError> {
        check_settings(&gates, &budget)?;
        let map_centre = map.map().centre()?;
        let map_id = (map.map().name().to_owned(), map.map().digest()?);
        // A pixel: no map says much better than that where a thing is.
        let budget = BudgetSettings { map_sigma_m: budget.map_sigma_m.max(map.map().m_per_px()), ..budget };
        Ok(Self { bundle, windows: Windows::new(map), map_centre, map_id, gates, budget })
    }

    /// Where was the vehicle? Never panics on any frame, pose or prior. `&mut` only for caches: the answer does not
    /// depend on earlier queries.
    pub fn locate(&mut self, query: &Query<'_>) -> Answer {
        self.locate_seen(query).0
    }

    /// As [`Localizer::locate`], and what was looked at.
    pub fn locate_seen(&mut self, query: &Query<'_>) -> (Answer, Seen) {
        self.locate_in(query, false)
    }

    /// The same; `searched`: in a disc that a search chose as the best of many, which the calibration does not cover.
    pub(super) fn locate_in(&mut self, query: &Query<'_>, searched: bool) -> (Answer, Seen) {
        let mut on_the_way = OnTheWay::default();
        let mut steps = Steps::start();
        let mut total = Steps::start();
        let outcome = self.answer(query, searched, &mut on_the_way, &mut steps);
        steps.done("gates");
        total.done("total");
        let mut latency_ms = super::Latency::new();
        for (name, ms) in steps.taken.iter().chain(&total.taken) {
            *latency_ms.entry((*name).to_owned()).or_insert(0.0) += ms;
        }
        let OnTheWay { prior, window, evidence, seen, withheld } = on_the_way;
        let bundle = Some(self.bundle.manifest.name.clone());
        (Answer { outcome, withheld, prior, bundle, searched: false, window, evidence, latency_ms }, seen)
    }

    /// The bundle.
    pub fn bundle(&self) -> &Bundle {
        &self.bundle
    }

    /// D_C: the widest disc that it searches, metres, where the frame's footprint is whole.
    pub fn search_radius_m(&self) -> f64 {
        self.bundle.manifest.search_radius_m
    }

    /// Whether it can do without a yaw.
    pub fn searches_circle(&self) -> bool {
        matches!(self.bundle.manifest.coarse, StageManifest::Correlation(_))
    }

    /// How many encoded windows are kept.
    pub(super) fn keep_windows(&mut self, count: usize) {
        self.windows.keep(count);
    }

    /// What a search over a region works with: the bundle, the map, the gates, the map's middle.
    pub(super) fn parts(&mut self) -> (&mut Bundle, &mut MapCache, &GateSettings, LatLon) {
        (&mut self.bundle, &mut self.windows.map, &self.gates, self.map_centre)
    }

    /// The map's file name and digest, for messages.
    pub fn map_id(&self) -> (String, String) {
        self.map_id.clone()
    }

    /// How many windows were encoded so far: one per window, not one per frame.
    pub fn map_encodes(&self) -> u64 {
        self.windows.encodes()
    }

    /// The gates, in the contract's order. `searched`: in a disc that a search chose.
    fn answer(&mut self, query: &Query<'_>, searched: bool, way: &mut OnTheWay, steps: &mut Steps) -> Result<Fix, NoFix> {
        let prior = query.prior.clone()?;
        way.prior = Some(prior);
        self.judge_prior(&prior)?;
        let (frame, pose) = self.read_frame(query, steps)?;
        let scale = frame.m_per_px / self.bundle.manifest.m_per_px;
        let way_frame = way.seen.frame.insert(frame);
        let view = FrameView { size_px: way_frame.size_px, gray: &way_frame.pixels, seen: &way_frame.valid };
        self.judge_map_reach(&prior, scale)?;
        self.judge_scaled_prior(&prior, scale)?;
        judge_frame(&view, &self.gates, &mut way.evidence)?;
        let texture = cues::frame_texture(&view);
        way.evidence.insert("frame_texture".into(), texture.coarse);
        way.evidence.insert("frame_smoothness".into(), texture.smoothness);
        steps.done("frame_gates");

        let manifest = &self.bundle.manifest;
        let (margin_px, frame_px, frame_width_m) = (manifest.margin_px(), manifest.frame_px(), manifest.frame_width_m);
        let slack_m = scale * (manifest.window_width_m - manifest.frame_width_m) / 2.0 - prior.radius_m;
        let centre = window_centre(self.map_centre, prior.position, slack_m);
        let width_m = scale * manifest.window_width_m;
        let m_per_px = scale * manifest.m_per_px;
        let spec = WindowSpec { centre, width_m: width_m + 2.0 * scale * manifest.window_margin_m, m_per_px };
        let kept = self.windows.get(&spec, &mut self.bundle, steps).map_err(no_window)?;
        let window = Arc::clone(&kept.window);
        way.seen.window = Some(Arc::clone(&window));
        let map_affine = affine_at_metres(&inner_affine(&window, margin_px), scale);
        way.window = Some(WindowInfo { centre, width_m, map_affine });
        steps.done("window");

        let (x, y) = window.to_px(prior.position);
        let search = Search {
            centre_px: [x - margin_px as f64, y - margin_px as f64],
            radius_m: prior.radius_m / scale,
            vehicle_px: [way_frame.vehicle_px.0, way_frame.vehicle_px.1],
            yaw_known: query.pose.yaw_deg.is_some(),
            crops: self.gates.crops,
        };
        let picture = WindowView { size_px: window.size_px, rgb: &window.rgb };
        let reach_px = prior.radius_m / scale + frame_width_m / 2.0;
        let texture = cues::map_texture(&picture, [x, y], reach_px);
        way.evidence.insert("map_texture".into(), texture.coarse);
        steps.done("map_texture");
        let found = match_pair(&mut self.bundle, &picture, &mut kept.map, &view, &search, steps).map_err(no_match)?;
        way.evidence.extend(found.evidence.iter().map(|(name, value)| (name.clone(), *value)));

        // Eq. (8), of the point under the vehicle.
        let [x, y] = found.homography.apply(way_frame.vehicle_px.0, way_frame.vehicle_px.1);
        if !(x.is_finite() && y.is_finite() && x.abs() < 1e6 && y.abs() < 1e6) {
            return Err(NoFix::new(Reason::NonFinite, format!("place of the vehicle: expected window pixels, found ({x}, {y})")));
        }
        let position = window.to_lat_lon(x + margin_px as f64, y + margin_px as f64);
        let position = LatLon::new(position.lat_deg, position.lon_deg);
        let position =
            position.ok_or_else(|| NoFix::new(Reason::NonFinite, "place of the vehicle: expected a position, found none"))?;
        let map_valid = map_valid_share(&found.homography, frame_px, &window, margin_px);
        way.evidence.insert("map_valid".into(), map_valid);
        let shape = cues::shape(&found.quad, self.bundle.manifest.frame_width_m);
        let agreement = cues::gradient_agreement(&view, &picture, margin_px as f64, &found.homography);
        for (name, value) in [
            ("quad_scale_error", shape.scale_error),
            ("quad_turn_deg", shape.turn_deg),
            ("quad_side_ratio", shape.side_ratio),
            ("gradient_agreement", agreement),
            ("prior_distance_share", position.distance_m(prior.position) / prior.radius_m.max(1.0)),
        ] {
            way.evidence.insert(name.into(), value);
        }
        if let Some(second) = way.evidence.get("second_peak").copied() {
            way.evidence.insert("mode_share".into(), 1.0 / (1.0 + second));
        }
        steps.done("cues");
        let integrity = self.bundle.manifest.integrity.as_ref();
        let judgement = integrity.map(|table| table.judge(&way.evidence));
        let judged = judge_quad(&found.quad, self.bundle.manifest.frame_width_m, search.yaw_known, &self.gates)
            .and_then(|()| judge_distance(position.distance_m(prior.position), prior.radius_m))
            .and_then(|()| judge_map(map_valid, &self.gates))
            .and_then(|()| judge_evidence(&way.evidence, integrity.is_some(), &self.gates))
            .and_then(|()| judge_probability(judgement.as_ref(), integrity.map_or(0.0, |table| table.bound_m), &self.gates));
        if let Err(no_fix) = judged {
            if self.gates.enabled {
                return Err(no_fix);
            }
            way.withheld = Some(no_fix.reason);
        }
        let judgement = judgement.and_then(Result::ok);
        // The calibration was made with a known yaw (a search of the circle tries thirty times as many hypotheses), at the
        // bundle's own scale, over maps about as fine as its pixels, with frames that are nearly whole and nearly nadir, in
        // discs of D_C, and of what the gates let through.
        let fine = self.windows.map.map().m_per_px() <= MAX_CALIBRATED_PX * m_per_px;
        let whole = way.evidence.get("frame_valid").is_some_and(|share| *share >= MIN_CALIBRATED_SEEN);
        let nadir = budget::cos_tilt(&pose) >= MAX_CALIBRATED_TILT_DEG.to_radians().cos();
        let calibrated = search.yaw_known && scale == 1.0 && fine && whole && nadir && !searched && way.withheld.is_none();
        let seen_as = Seeing { pose: &pose, agl_m: way_frame.agl_m, scale, calibrated };
        let fix = self.fix(position, &found, &seen_as, judgement, &mut way.evidence);
        if let Some(sigma_m) = prior.sigma_m {
            let variance_m2 = sigma_m * sigma_m + fix.covariance_enu_m2[0][0].max(fix.covariance_enu_m2[1][1]);
            way.evidence.insert("prior_chi2".into(), position.distance_m(prior.position).powi(2) / variance_m2);
        }
        Ok(fix)
    }

    /// `no_prior` for a prior that is none, `prior_too_wide`.
    fn judge_prior(&self, prior: &Prior) -> Result<(), NoFix> {
        if LatLon::new(prior.position.lat_deg, prior.position.lon_deg).is_none() {
            let detail = format!("prior: expected a position, found ({}, {})", prior.position.lat_deg, prior.position.lon_deg);
            return Err(NoFix::new(Reason::NoPrior, detail));
        }
        let most_m = self.bundle.manifest.search_radius_m;
        if prior.radius_m.is_nan() || prior.radius_m < 0.0 {
            return Err(NoFix::new(Reason::NoPrior, format!("prior: expected a radius in metres, found {}", prior.radius_m)));
        }
        if prior.radius_m > most_m * (1.0 + RADIUS_SLACK) {
            let detail = format!("search radius: expected at most {most_m} m (D_C of the bundle), found {:.1} m", prior.radius_m);
            return Err(NoFix::new(Reason::PriorTooWide, detail));
        }
        Ok(())
    }

    /// `prior_too_wide` at the scale of this frame. A ladder tries its next rung, or a search; where neither can, it says
    /// `footprint_too_small`.
    fn judge_scaled_prior(&self, prior: &Prior, scale: f64) -> Result<(), NoFix> {
        let most_m = scale * self.bundle.manifest.search_radius_m;
        if prior.radius_m <= most_m * (1.0 + RADIUS_SLACK) {
            return Ok(());
        }
        let detail = format!(
            "search radius: expected at most {most_m:.1} m (D_C of the bundle at {scale:.3} of its scale, for so low a frame), \
             found {:.1} m",
            prior.radius_m
        );
        Err(NoFix::new(Reason::PriorTooWide, detail))
    }

    /// Decode, tone mapping, rectification: `bad_frame`. Also the pose that was assumed.
    pub(super) fn read_frame(&self, query: &Query<'_>, steps: &mut Steps) -> Result<(Rectified, Pose), NoFix> {
        let bad = |e: &dyn std::fmt::Display| NoFix::new(Reason::BadFrame, e.to_string());
        let encoded = query.frame.as_ref().map_err(|e| bad(e))?;
        if query.pose.yaw_deg.is_none() && !self.searches_circle() {
            return Err(bad(&"yaw_deg: expected a known yaw (this bundle does not search the circle), found none"));
        }
        let raw = decode(encoded.bytes, encoded.encoding, encoded.size_px).map_err(|e| bad(&e))?;
        steps.done("decode");
        let gray = tone_map(&raw);
        steps.done("tone");
        // With an unknown yaw the circle is searched from north up.
        let pose = Pose { yaw_deg: query.pose.yaw_deg.or(Some(0.0)), ..query.pose };
        let manifest = &self.bundle.manifest;
        let scale = scale_for(manifest, pose.footprint_m(gray.width.min(gray.height), gray.width));
        let frame = rectify(&gray, &pose, manifest.frame_px(), scale * manifest.m_per_px).map_err(|e| bad(&e))?;
        steps.done("rectify");
        Ok((frame, pose))
    }

    /// `off_map`.
    pub(super) fn judge_map_reach(&mut self, prior: &Prior, scale: f64) -> Result<(), NoFix> {
        let side_m = scale * self.bundle.manifest.frame_width_m;
        let share = self.gates.min_map_valid;
        let held = self.windows.map.can_hold(prior.position, prior.radius_m, side_m, share);
        let held = held.map_err(|e| NoFix::new(Reason::OffMap, e.to_string()))?;
        if held {
            return Ok(());
        }
        let detail = format!(
            "within {:.0} m of the prior: expected a {side_m} m square at least {share} on valid map, found none",
            prior.radius_m
        );
        Err(NoFix::new(Reason::OffMap, detail))
    }

    fn fix(
        &self,
        position: LatLon,
        found: &PairMatch,
        seeing: &Seeing<'_>,
        judgement: Option<Judgement>,
        evidence: &mut Evidence,
    ) -> Fix {
        let manifest = &self.bundle.manifest;
        let last = match (&found.stage, &manifest.refine) {
            (StageName::Refine, Some(refine)) => refine,
            _ => &manifest.coarse,
        };
        let Seeing { pose, agl_m, scale, calibrated } = *seeing;
        // Beyond what the calibration saw its sigma still counts where it is the wider one.
        let least_m = if calibrated { 0.0 } else { last.match_sigma_m() };
        let (match_sigma_m, tail999) = judgement.map_or((last.match_sigma_m(), 0.0), |j| (j.sigma_m.max(least_m), j.tail999));
        let judgement = judgement.filter(|_| calibrated);
        if scale != 1.0 {
            evidence.insert("matched_scale".into(), scale);
        }
        let error = budget::stated_error(&self.budget, match_sigma_m * scale, tail999, pose, agl_m, evidence);
        let found_as = similarity_of(manifest.frame_px(), &found.quad);
        Fix {
            position,
            covariance_enu_m2: error.covariance_enu_m2,
            radius95_m: error.radius95_m,
            radius999_m: error.radius999_m,
            calibrated: judgement.is_some(),
            p_over_25m: judgement.map(|j| j.p_over_bound),
            yaw_deg: (pose.yaw_deg.unwrap_or(0.0) + found_as.rotation_deg).rem_euclid(360.0),
            scale: found_as.scale,
            stage: found.stage,
            homography: homography_at_metres(&found.homography, scale, manifest.frame_px()).0,
        }
    }
}

/// How a frame was looked at.
struct Seeing<'a> {
    pose: &'a Pose,
    agl_m: Option<f64>,
    /// Of frame and window against the bundle's own.
    scale: f64,
    /// Whether the bundle's calibration, where it has one, was made under such conditions.
    calibrated: bool,
}

/// What is known on the way, whichever gate closes.
#[derive(Default)]
struct OnTheWay {
    withheld: Option<Reason>,
    prior: Option<Prior>,
    window: Option<WindowInfo>,
    evidence: Evidence,
    seen: Seen,
}

fn no_window(error: WindowError) -> NoFix {
    match error {
        WindowError::Map(e) => NoFix::new(Reason::OffMap, e.to_string()),
        WindowError::Pair(e) => no_match(e),
    }
}

fn no_match(error: PairError) -> NoFix {
    let reason = match &error {
        PairError::YawNeeded { .. } => Reason::BadFrame,
        PairError::NonFinite { .. } | PairError::Graph(_) => Reason::NonFinite,
    };
    NoFix::new(reason, error.to_string())
}

fn check_settings(gates: &GateSettings, budget: &BudgetSettings) -> Result<(), LocateError> {
    let shares = [
        ("gates.min_map_valid", gates.min_map_valid),
        ("gates.min_frame_valid", gates.min_frame_valid),
        ("gates.min_side_ratio", gates.min_side_ratio),
        ("gates.min_peak_mass", gates.min_peak_mass),
        ("gates.max_p_over_25m", gates.max_p_over_25m),
    ];
    let sizes = [
        ("gates.min_frame_std", gates.min_frame_std),
        ("gates.max_scale_error", gates.max_scale_error),
        ("gates.max_rotation_deg", gates.max_rotation_deg),
        ("gates.max_second_peak", gates.max_second_peak),
        ("gates.max_stage_shift_m", gates.max_stage_shift_m),
        ("gates.max_refine_residual_m", gates.max_refine_residual_m),
        ("budget.sigma_tilt_deg", budget.sigma_tilt_deg),
        ("budget.sigma_tilt_unknown_deg", budget.sigma_tilt_unknown_deg),
        ("budget.assumed_agl_m", budget.assumed_agl_m),
        ("budget.map_sigma_m", budget.map_sigma_m),
        ("budget.sigma_stamp_s", budget.sigma_stamp_s),
        ("budget.speed_mps", budget.speed_mps),
        ("budget.floor_m", budget.floor_m),
    ];
    for (field, found) in shares {
        if !(0.0..=1.0).contains(&found) {
            return Err(LocateError::Setting { field, expected: "0 to 1", found });
        }
    }
    for (field, found) in sizes {
        if !(0.0..=1e6).contains(&found) {
            return Err(LocateError::Setting { field, expected: "a finite number from 0 on", found });
        }
    }
    Ok(())
}
