//! What a localisation gives.

use super::Prior;
use crate::geo::LatLon;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Reasons for "no fix", in the order in which they are tested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// No prior was given.
    NoPrior,
    /// The prior is too old.
    StalePrior,
    /// The search disc is wider than the bundle's D_C.
    PriorTooWide,
    /// The frame cannot be read, or what is needed to rectify it is unknown.
    BadFrame,
    /// Nowhere in the disc does the footprint lie at least 90 % on valid map.
    OffMap,
    /// The frame covers too little of the square the bundle needs.
    FootprintTooSmall,
    /// The frame has no structure.
    FlatFrame,
    /// The network gave a number that is not finite.
    NonFinite,
    /// The fitted quad is none that a downward camera could see.
    ImplausibleQuad,
    /// The result lies outside the search disc.
    OutsidePrior,
    /// Under 90 % valid map inside the fitted quad.
    Nodata,
    /// The evidence is too weak.
    LowEvidence,
    /// Two places fit about as well.
    Ambiguous,
    /// Held back until confirmed.
    HeldBack,
    /// Not done in time.
    Deadline,
}

/// A plain "no fix".
#[derive(Debug, Clone, PartialEq)]
pub struct NoFix {
    /// Which gate.
    pub reason: Reason,
    /// What was expected and what was found, for a human.
    pub detail: String,
}

/// Which stage a result comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum StageName {
    /// First stage only.
    Coarse,
    /// Both stages.
    Refine,
}

/// A position fix.
#[derive(Debug, Clone, PartialEq)]
pub struct Fix {
    /// The vehicle: the point under the camera.
    pub position: LatLon,
    /// East-north covariance, square metres.
    pub covariance_enu_m2: [[f64; 2]; 2],
    /// Radius that holds the true position with probability 0.95, metres.
    pub radius95_m: f64,
    /// The same for 0.999, metres.
    pub radius999_m: f64,
    /// Whether those numbers were calibrated.
    pub calibrated: bool,
    /// Calibrated probability that the error is above 25 m, where the bundle has a calibration.
    pub p_over_25m: Option<f64>,
    /// Recovered yaw of image up, degrees clockwise from true north, 0..360.
    pub yaw_deg: f64,
    /// Recovered frame metres / assumed metres.
    pub scale: f64,
    /// Which stage.
    pub stage: StageName,
    /// Rectified-frame px (512 x 512 at 1 m/px) -> window px at 1 m/px, row-major, `[2][2] == 1`.
    pub homography: [[f64; 3]; 3],
}

/// The window that was searched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindowInfo {
    /// Its middle.
    pub centre: LatLon,
    /// W_S, metres.
    pub width_m: f64,
    /// Window px (1 m/px) -> map CRS.
    pub map_affine: [f64; 6],
}

/// Named numbers that speak for or against a fix (sorted by name, so that output is stable).
pub type Evidence = BTreeMap<String, f64>;

/// Milliseconds by step (sorted by name). The only part of an answer that may differ between two runs.
pub type Latency = BTreeMap<String, f64>;

/// The answer to a query: a fix or a "no fix", and what is known either way.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// The outcome.
    pub outcome: Result<Fix, NoFix>,
    /// With gates off: the gate that would have closed.
    pub withheld: Option<Reason>,
    /// The prior that was used.
    pub prior: Option<Prior>,
    /// Name of the bundle that answered; none where no bundle was asked.
    pub bundle: Option<String>,
    /// Whether it was found by a search beyond the bundle's D_C: never published before another frame confirms it.
    pub searched: bool,
    /// The window, where one was made.
    pub window: Option<WindowInfo>,
    /// Evidence gathered up to the gate that closed.
    pub evidence: Evidence,
    /// Milliseconds by step.
    pub latency_ms: Latency,
}

impl Answer {
    /// One of which nothing is known but its outcome and its prior.
    pub fn bare(outcome: Result<Fix, NoFix>, prior: Option<Prior>) -> Self {
        Self {
            outcome,
            withheld: None,
            prior,
            bundle: None,
            searched: false,
            window: None,
            evidence: Evidence::new(),
            latency_ms: Latency::new(),
        }
    }
}

#[cfg(test)]
impl Fix {
    /// For tests: unturned, of the refine stage, not calibrated; 1-sigma per axis, metres.
    pub(crate) fn plain(position: LatLon, sigma_m: f64) -> Self {
        Self {
            position,
            covariance_enu_m2: [[sigma_m * sigma_m, 0.0], [0.0, sigma_m * sigma_m]],
            radius95_m: 1.0,
            radius999_m: 1.0,
            calibrated: false,
            p_over_25m: None,
            yaw_deg: 0.0,
            scale: 1.0,
            stage: StageName::Refine,
            homography: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        }
    }
}
