//! Replay: every row of a recorded flight through the localizer, in order, one line each.
//!
//! No clock, network or absolute path enters a line, so that two runs differ in `latency_ms` only.

use super::format::{Flight, Row};
use super::metrics::{Metrics, Tally};
use crate::bus::{FixMessage, MapId};
use crate::config::BudgetSettings;
use crate::locate::{Answer, EncodedFrame, Ladder, NoFix, Prior, PriorSource, Query, Reason, tilt_was_assumed};
use crate::thermal::{FrameError, decode};
use crate::track::{Guard, PriorReport, Spread, Tracker};
use serde::Serialize;

/// One line of `fixes.jsonl`: the message, and what only a replay knows.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReplayLine {
    /// As published by the service.
    #[serde(flatten)]
    pub message: FixMessage,
    /// The frame, as `poses.csv` names it.
    pub file: String,
    /// Geodesic distance of fix and truth, metres; null without a fix or without truth.
    pub error_m: Option<f64>,
}

/// How a replay went.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayReport {
    /// Over all lines.
    pub metrics: Metrics,
    /// Frames that could not be read: the run finished with data loss.
    pub unreadable: usize,
}

/// Whoever answers queries: the [`Ladder`], or a stand-in in tests.
pub trait Locate {
    /// Where was the vehicle?
    fn locate(&mut self, query: &Query<'_>) -> Answer;
    /// Bundle name and map, for the lines.
    fn identity(&self) -> (String, MapId);
}

impl Locate for Ladder {
    fn locate(&mut self, query: &Query<'_>) -> Answer {
        Self::locate(self, query)
    }
    fn identity(&self) -> (String, MapId) {
        let (name, digest) = self.map_id();
        (self.name(), MapId { name, digest })
    }
}

/// Replays a flight. `line` is called with each line, in order; an error of its own ends the replay.
pub fn replay<E>(
    flight: &Flight,
    localizer: &mut impl Locate,
    budget: &BudgetSettings,
    mut tracker: Tracker,
    mut guard: Guard,
    mut line: impl FnMut(&ReplayLine) -> Result<(), E>,
) -> Result<ReplayReport, E> {
    let (bundle, map) = localizer.identity();
    let (mut tally, mut unreadable) = (Tally::default(), 0);
    for (seq, row) in (0_u64..).zip(&flight.rows) {
        let frame = flight.frame(row);
        let query = Query {
            stamp_ns: row.stamp_ns,
            frame: match &frame {
                Ok((bytes, encoding)) => Ok(EncodedFrame { bytes, encoding: *encoding, size_px: None }),
                Err(error) => Err(error.clone()),
            },
            pose: flight.camera.camera_pose(&crate::thermal::Pose { hfov_deg: flight.camera.hfov_deg, ..row.pose }),
            prior: prior(row, &mut tracker),
        };
        let mut answer = localizer.locate(&query);
        if !row.pose.tilt_known() {
            tilt_was_assumed(budget, &mut answer);
        }
        let bytes = query.frame.as_ref().ok().map(|frame| frame.bytes);
        guard.judge(row.stamp_ns, bytes, tracker.external_at(row.stamp_ns).as_ref(), &mut answer);
        tracker.record(row.stamp_ns, seq, &answer);
        unreadable += usize::from(is_unreadable(&query.frame, &answer));
        let message = FixMessage::new(row.stamp_ns, seq, &answer, &bundle, &map);
        let error_m = tally.add(row, &message);
        line(&ReplayLine { message, file: row.file.clone(), error_m })?;
    }
    Ok(ReplayReport { metrics: tally.metrics(), unreadable })
}

/// The row's own prior where it has one, else what is known from earlier rows.
fn prior(row: &Row, tracker: &mut Tracker) -> Result<Prior, NoFix> {
    let Some(given) = row.prior else { return tracker.prior_at(row.stamp_ns) };
    let Some(spread) = given.spread else {
        let detail = "prior: expected prior_sigma_m or prior_radius_m beside the position, found neither".to_owned();
        return Err(NoFix { reason: Reason::NoPrior, detail });
    };
    tracker.report(PriorReport { stamp_ns: row.stamp_ns, position: given.position, spread, fix_seq: None });
    let (radius_m, sigma_m) = match spread {
        Spread::RadiusM(m) => (m, None),
        Spread::SigmaM(m) => (3.0 * m, Some(m)),
    };
    Ok(Prior { position: given.position, radius_m, sigma_m, source: PriorSource::External, chain: 0, age_s: Some(0.0) })
}

/// Whether the frame is lost: its file cannot be read, or its bytes are no image. A frame that is `bad_frame` because
/// its pose says too little is not.
fn is_unreadable(frame: &Result<EncodedFrame<'_>, FrameError>, answer: &Answer) -> bool {
    let bad = matches!(&answer.outcome, Err(NoFix { reason: Reason::BadFrame, .. }));
    match frame {
        Err(_) => true,
        Ok(frame) => bad && decode(frame.bytes, frame.encoding, frame.size_px).is_err(),
    }
}

#[cfg(test)]
#[path = "replay_tests.rs"]
mod tests;
