//! Messages out: the fix message, one layout for Zenoh, `fixes.jsonl` and `locate --json`.

use crate::geo::LatLon;
use crate::locate::{Answer, Evidence, Latency, PriorSource, Reason, StageName};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `fix` or `no_fix`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// A position.
    Fix,
    /// None; see `reason`.
    NoFix,
}

/// One answer, as published. Without a fix the optional fields are absent: not stale, not zero.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FixMessage {
    /// Exposure, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Counts the messages from 0: of a replay its rows; of the service its answers, where 0 is what the queryable
    /// answers before the first frame.
    pub seq: u64,
    /// Fix or not.
    pub status: Status,
    /// Why not; absent with a fix.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<Reason>,
    /// With gates off: the reason for which they would have withheld this fix.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub withheld: Option<Reason>,
    /// The reason in words: what was expected, what was found; absent with a fix.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detail: Option<String>,
    /// Latitude of the vehicle, WGS84 degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lat_deg: Option<f64>,
    /// Longitude of the vehicle, WGS84 degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lon_deg: Option<f64>,
    /// East-north covariance, square metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub covariance_enu_m2: Option<[[f64; 2]; 2]>,
    /// Radius that holds the truth with probability 0.95, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius95_m: Option<f64>,
    /// Radius that holds the truth with probability 0.999, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius999_m: Option<f64>,
    /// Whether the stated error was calibrated. False without a fix.
    pub calibrated: bool,
    /// Probability that the error is above 25 m; absent where the bundle has no calibration.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p_over_25m: Option<f64>,
    /// Recovered yaw of image up, degrees clockwise from true north.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub yaw_deg: Option<f64>,
    /// Recovered frame metres / assumed metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// Whether it was found by a search beyond the bundle's D_C (and confirmed by another frame).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub searched: bool,
    /// Which stage the result comes from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stage: Option<StageName>,
    /// W_S, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window_m: Option<f64>,
    /// Rectified-frame px (512 x 512 at 1 m/px) -> window px at 1 m/px; row-major, `[2][2] == 1`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub homography: Option<[[f64; 3]; 3]>,
    /// The window searched; absent where none was made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window: Option<WindowMessage>,
    /// Named numbers for or against the fix.
    pub evidence: Evidence,
    /// Name of the bundle that answered.
    pub bundle: String,
    /// The map.
    pub map: MapId,
    /// The prior used; absent where there was none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior: Option<PriorEcho>,
    /// Milliseconds by step.
    pub latency_ms: Latency,
}

/// What the queryable on `fix` answers: the last message and its age.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LastFixMessage {
    /// The last message, fix or not; before the first frame a "no fix" with reason `no_prior` and `seq` 0.
    #[serde(flatten)]
    pub message: FixMessage,
    /// Milliseconds since that message was made, by a clock that does not step (before the first frame: since start).
    pub age_ms: u64,
}

/// One state of the optional track: published fixes, filtered. Beside the raw fixes, never instead of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrackMessage {
    /// Exposure of the fix that led to it, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Message number of that fix.
    pub fix_seq: u64,
    /// Latitude of the vehicle, WGS84 degrees.
    pub lat_deg: f64,
    /// Longitude of the vehicle, WGS84 degrees.
    pub lon_deg: f64,
    /// East-north covariance, square metres; never below what neighbouring fixes have in common.
    pub covariance_enu_m2: [[f64; 2]; 2],
    /// East and north, metres per second.
    pub velocity_enu_mps: [f64; 2],
    /// Squared innovation of the fix in units of its covariance, 2 degrees of freedom; absent where the track begins.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub innovation_nees: Option<f64>,
    /// Whether the stated errors of all fixes from the lagged one on were calibrated: then none was found by a search.
    pub calibrated: bool,
    /// What is known now of an earlier fix's place.
    pub lagged: LaggedState,
}

/// An earlier place on the track, in the light of the fixes since.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LaggedState {
    /// Exposure, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Message number of the fix then.
    pub fix_seq: u64,
    /// Latitude of the vehicle, WGS84 degrees.
    pub lat_deg: f64,
    /// Longitude of the vehicle, WGS84 degrees.
    pub lon_deg: f64,
    /// East-north covariance, square metres.
    pub covariance_enu_m2: [[f64; 2]; 2],
}

/// The searched window.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct WindowMessage {
    /// Latitude of its middle.
    pub lat_deg: f64,
    /// Longitude of its middle.
    pub lon_deg: f64,
    /// Side, metres.
    pub width_m: f64,
    /// Window px (1 m/px) -> map CRS: x' = a x + b y + c, y' = d x + e y + f.
    pub map_affine: [f64; 6],
}

/// Which map.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct MapId {
    /// File name.
    pub name: String,
    /// SHA-256 of the file, lower-case hex.
    pub digest: String,
}

/// The prior, as used.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PriorEcho {
    /// Who said so.
    pub source: PriorSource,
    /// How many own fixes deep.
    pub chain: u32,
    /// Latitude.
    pub lat_deg: f64,
    /// Longitude.
    pub lon_deg: f64,
    /// Search radius, metres.
    pub radius_m: f64,
    /// 1-sigma per axis, metres, where given so.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma_m: Option<f64>,
    /// Age at exposure, seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub age_s: Option<f64>,
}

impl FixMessage {
    /// The message for an answer; `bundle` is named where the answer names none.
    pub fn new(stamp_ns: i64, seq: u64, answer: &Answer, bundle: &str, map: &MapId) -> Self {
        let (fix, no_fix) = match &answer.outcome {
            Ok(fix) => (Some(fix), None),
            Err(no_fix) => (None, Some(no_fix)),
        };
        Self {
            stamp_ns,
            seq,
            status: if fix.is_some() { Status::Fix } else { Status::NoFix },
            reason: no_fix.map(|n| n.reason),
            withheld: answer.withheld,
            detail: no_fix.map(|n| n.detail.clone()),
            lat_deg: fix.map(|f| f.position.lat_deg),
            lon_deg: fix.map(|f| f.position.lon_deg),
            covariance_enu_m2: fix.map(|f| f.covariance_enu_m2),
            radius95_m: fix.map(|f| f.radius95_m),
            radius999_m: fix.map(|f| f.radius999_m),
            calibrated: fix.is_some_and(|f| f.calibrated),
            p_over_25m: fix.and_then(|f| f.p_over_25m),
            yaw_deg: fix.map(|f| f.yaw_deg),
            scale: fix.map(|f| f.scale),
            searched: answer.searched && fix.is_some(),
            stage: fix.map(|f| f.stage),
            window_m: answer.window.map(|w| w.width_m),
            homography: fix.map(|f| f.homography),
            window: answer.window.map(|w| WindowMessage {
                lat_deg: w.centre.lat_deg,
                lon_deg: w.centre.lon_deg,
                width_m: w.width_m,
                map_affine: w.map_affine,
            }),
            evidence: finite(&answer.evidence),
            bundle: answer.bundle.as_deref().unwrap_or(bundle).to_owned(),
            map: map.clone(),
            prior: answer.prior.map(|p| PriorEcho {
                source: p.source,
                chain: p.chain,
                lat_deg: p.position.lat_deg,
                lon_deg: p.position.lon_deg,
                radius_m: p.radius_m,
                sigma_m: p.sigma_m,
                age_s: p.age_s,
            }),
            latency_ms: answer.latency_ms.clone(),
        }
    }

    /// The position, with a fix.
    pub fn position(&self) -> Option<LatLon> {
        LatLon::new(self.lat_deg?, self.lon_deg?)
    }
}

/// What JSON can say: a cue without a number (a quad whose sides cross has no ratio) is left out.
fn finite(evidence: &Evidence) -> Evidence {
    evidence.iter().filter(|(_, value)| value.is_finite()).map(|(name, value)| (name.clone(), *value)).collect()
}
