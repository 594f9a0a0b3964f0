//! What can be configured. Defaults stand in `config/nightfix.toml`, not here.

use crate::thermal::CameraModel;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// The whole configuration.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Vehicle.
    pub vehicle: VehicleSettings,
    /// Map.
    pub map: MapSettings,
    /// Bundle.
    pub bundle: BundleSettings,
    /// ONNX Runtime.
    pub onnxruntime: OnnxRuntimeSettings,
    /// Camera.
    pub camera: CameraModel,
    /// Prior and tracking.
    pub track: TrackSettings,
    /// Search over a region.
    pub search: SearchSettings,
    /// Gates.
    pub gates: GateSettings,
    /// Error budget.
    pub budget: BudgetSettings,
    /// Zenoh.
    pub zenoh: ZenohSettings,
    /// Daemon.
    pub daemon: DaemonSettings,
}

/// Who we are.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleSettings {
    /// One chunk of the Zenoh key: letters, digits, `-`, `_`.
    pub name: String,
}

/// Which map.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapSettings {
    /// GeoTIFF.
    pub path: Option<PathBuf>,
    /// Bound on decoded tiles, MiB.
    pub cache_mib: usize,
}

/// Which bundle.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BundleSettings {
    /// Folder of the bundle.
    pub path: Option<PathBuf>,
    /// Folders of further bundles, with smaller or larger D_C: the smallest whose D_C covers the search disc answers.
    pub ladder: Vec<PathBuf>,
}

/// Search over a region wider than the largest bundle's D_C.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SearchSettings {
    /// Widest search disc, metres; 0: none is searched, a prior wider than D_C is `prior_too_wide`.
    pub max_radius_m: f64,
    /// Time after which the service gives up a frame's search (`deadline`), milliseconds. A replay has no clock.
    pub budget_ms: u64,
    /// Places that are looked at closely.
    pub candidates: u32,
    /// Largest ratio of another place's weight to the best one's (`ambiguous`). Stricter than within a disc
    /// (`gates.max_second_peak`): where a place lies between cells changes its weight by half, and there are many places.
    pub max_second: f64,
    /// Bound on the region's features that are kept, MiB: about 1.7 per km2.
    pub max_features_mib: usize,
}

/// ONNX Runtime.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnnxRuntimeSettings {
    /// Shared library; searched beside the executable where absent.
    pub library: Option<PathBuf>,
    /// `cpu`, `cuda`, `tensorrt` or `xnnpack`. One that is not available is an error, never a silent fall-back.
    pub provider: String,
    /// Threads within one graph.
    pub threads: usize,
}

/// Priors and tracking.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackSettings {
    /// Fastest the vehicle moves, metres per second: growth of uncertainty with age.
    pub max_speed_mps: f64,
    /// Least 1-sigma per axis of a prior taken from an own fix, metres.
    pub own_fix_sigma_m: f64,
    /// "No fix" in a row after which the last external prior is taken again.
    pub fall_back_after_no_fix: u32,
    /// Seconds since the last own fix after which the last external prior is taken again.
    pub fall_back_after_s: f64,
    /// Age beyond which an external prior is stale, seconds.
    pub max_prior_age_s: f64,
    /// What two fixes may lie apart beyond motion and 3 sigma of both, metres (`held_back`).
    pub jump_slack_m: f64,
    /// Earlier answers that must agree with one that is held back.
    pub confirmations: u32,
    /// Answers this far apart are of other ground, metres.
    pub confirm_distance_m: f64,
    /// A jump (not what a search found) is also confirmed by answers this much apart in time, seconds: not calibrated.
    pub confirm_after_s: f64,
    /// Answers further apart in time do not confirm each other, seconds.
    pub confirm_within_s: f64,
    /// Largest ratio of what counts as agreement (a radius) to the radius of a search.
    pub max_agreement_share: f64,
    /// Last steps between external priors: where all of them, or as many as there are, are such as the vehicle can fly, their
    /// source is continuous and explains no jump of a fix.
    pub steady_reports: u32,
    /// The same picture so many times, among the last 16, is `held_back`,
    pub frozen_frames: u32,
    /// where the first and the last are at least this far apart, seconds: some streams repeat a slow camera's pictures.
    pub frozen_after_s: f64,
    /// Whether the smoothed track is published beside the fixes.
    pub publish_track: bool,
    /// The smoother's lag, fixes.
    pub track_lag_fixes: u32,
    /// White acceleration of the track's motion, 1-sigma, metres per second squared.
    pub track_accel_mps2: f64,
    /// Largest squared normalised innovation of a fix that goes into the track.
    pub track_gate: f64,
    /// Fixes left out in a row after which the track begins anew.
    pub track_restart_after: u32,
}

/// Gates. `enabled = false` (replay `--gates off`) leaves only what has no answer: reasons up to `non_finite`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GateSettings {
    /// Whether gates from `implausible_quad` on close.
    pub enabled: bool,
    /// Least share of valid map under a footprint (`off_map`, `nodata`).
    pub min_map_valid: f64,
    /// Least share of the frame's square that the sensor saw (`footprint_too_small`).
    pub min_frame_valid: f64,
    /// Least standard deviation of the 8-bit frame (`flat_frame`).
    pub min_frame_std: f64,
    /// Largest |scale - 1| of the quad.
    pub max_scale_error: f64,
    /// Largest turn of the quad against the assumed yaw, degrees.
    pub max_rotation_deg: f64,
    /// Least ratio of opposite sides of the quad.
    pub min_side_ratio: f64,
    /// Least posterior mass round the coarse peak (`low_evidence`).
    pub min_peak_mass: f64,
    /// Largest ratio of the second peak to the first (`ambiguous`).
    pub max_second_peak: f64,
    /// Largest distance between the coarse and the refined centre, metres (`low_evidence`).
    pub max_stage_shift_m: f64,
    /// Largest weighted residual of the refine stage's patches, metres (`low_evidence`).
    pub max_refine_residual_m: f64,
    /// Largest calibrated probability of an error above 25 m (`low_evidence`); for bundles that are calibrated.
    pub max_p_over_25m: f64,
    /// Whether the refine stage also sees the frame with parts covered: evidence, for four more frames of its cost. A
    /// calibration that was made with it needs it.
    pub crops: bool,
}

/// Error budget, 1-sigma.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BudgetSettings {
    /// Attitude error per axis, degrees; times height above ground, over the squared cosine of the tilt.
    pub sigma_tilt_deg: f64,
    /// Attitude error where pitch and roll are unknown and nadir is assumed, degrees.
    pub sigma_tilt_unknown_deg: f64,
    /// Height above ground assumed for the tilt term where it is unknown, metres.
    pub assumed_agl_m: f64,
    /// Absolute accuracy of the map per axis, metres; a pixel of the map where that is more.
    pub map_sigma_m: f64,
    /// Error of the frames' time stamps, seconds; times `speed_mps`.
    pub sigma_stamp_s: f64,
    /// Speed that is assumed for the time stamp's term, metres per second.
    pub speed_mps: f64,
    /// Never below this per axis, metres.
    pub floor_m: f64,
}

/// Zenoh.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ZenohSettings {
    /// `peer` or `client`.
    pub mode: String,
    /// Endpoints to connect to.
    pub connect: EndpointSettings,
    /// Endpoints to listen on; none by default.
    pub listen: EndpointSettings,
    /// Whether multicast scouting is on.
    pub multicast: bool,
    /// A Zenoh configuration file (JSON5) laid under these settings: TLS, access control.
    pub config_file: Option<PathBuf>,
}

/// Endpoints.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EndpointSettings {
    /// For example `tcp/127.0.0.1:7447`.
    pub endpoints: Vec<String>,
}

/// The daemon.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DaemonSettings {
    /// An accepted frame must be answered within this, milliseconds: the watchdog's and the gate `deadline`.
    pub deadline_ms: u64,
    /// An attitude further than this from the exposure is unknown, seconds.
    pub max_attitude_age_s: f64,
    /// Largest frame payload, bytes.
    pub max_frame_bytes: usize,
}
