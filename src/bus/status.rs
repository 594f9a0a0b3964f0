//! The status message: what the service does, what it has seen, what it runs with.

use super::message::{MapId, Status};
use crate::locate::Reason;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What the service is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Alive, but no frame came for five seconds (or none yet).
    Idle,
    /// The last answer was a fix.
    Fix,
    /// The last answer was a "no fix", or none was given yet.
    NoFix,
    /// On its way out.
    Stopping,
}

/// Health, once a second and on change of `state`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StatusMessage {
    /// When it was made, Unix UTC nanoseconds by this machine's clock.
    pub stamp_ns: i64,
    /// Vehicle name.
    pub vehicle: String,
    /// What the service is doing.
    pub state: State,
    /// nightfix's version.
    pub version: String,
    /// Seconds since start, by a clock that does not step.
    pub uptime_s: f64,
    /// Bundle name.
    pub bundle: String,
    /// The map.
    pub map: MapId,
    /// Execution provider.
    pub provider: String,
    /// Frames.
    pub frames: FrameCounts,
    /// Fixes given.
    pub fixes: u64,
    /// "No fix" given, by reason.
    pub no_fix: BTreeMap<Reason, u64>,
    /// Answers that were given and could not be published: the publishing queue was full.
    pub answers_unpublished: u64,
    /// Priors.
    pub priors: InputCounts,
    /// Attitudes.
    pub attitudes: InputCounts,
    /// Exposure of the last frame answered; absent before the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_stamp_ns: Option<i64>,
    /// Outcome of the last frame answered; absent before the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_status: Option<Status>,
    /// Milliseconds from the arrival of the last frame answered to its answer; absent before the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_latency_ms: Option<f64>,
}

/// Frames since start. `received = accepted + bad`; `accepted` = answers + `dropped` + at most two under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FrameCounts {
    /// Came in.
    pub received: u64,
    /// Will be answered unless dropped. A frame that is refused but whose stamp can be read is answered (`bad_frame`).
    pub accepted: u64,
    /// Displaced by a newer frame before their turn: never answered.
    pub dropped: u64,
    /// Without a readable stamp: cannot be answered.
    pub bad: u64,
}

/// Messages of another kind since start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct InputCounts {
    /// Came in.
    pub received: u64,
    /// Refused.
    pub bad: u64,
}
