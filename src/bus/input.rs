//! Messages in: frame attachment, prior, attitude. Untrusted.

use crate::thermal::Encoding;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The attachment of a frame (JSON); the payload is the image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FrameAttachment {
    /// Exposure, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// How to read the payload.
    pub encoding: Encoding,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Height above ground, metres.
    pub agl_m: Option<f64>,
    /// Ground metres per pixel.
    pub gsd_m: Option<f64>,
    /// Horizontal field of view, degrees.
    pub hfov_deg: Option<f64>,
    /// Camera yaw, degrees clockwise from true north.
    pub yaw_deg: Option<f64>,
    /// Camera pitch, degrees; 0 is nadir.
    pub pitch_deg: Option<f64>,
    /// Camera roll, degrees.
    pub roll_deg: Option<f64>,
}

/// A prior from outside.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PriorMessage {
    /// When it held, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Latitude, degrees.
    pub lat_deg: f64,
    /// Longitude, degrees.
    pub lon_deg: f64,
    /// 1-sigma per axis, metres. Exactly one of `sigma_m` and `radius_m`.
    pub sigma_m: Option<f64>,
    /// Hard bound, metres.
    pub radius_m: Option<f64>,
    /// The number of our fix that it echoes.
    pub fix_seq: Option<u64>,
}

/// The vehicle's attitude.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AttitudeMessage {
    /// When it held, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Vehicle roll, degrees.
    pub roll_deg: f64,
    /// Vehicle pitch, degrees.
    pub pitch_deg: f64,
    /// Vehicle yaw, degrees clockwise from true north.
    pub yaw_deg: f64,
    /// Height above ground, metres.
    pub agl_m: Option<f64>,
}

/// What can be wrong with a payload.
#[derive(Debug, thiserror::Error)]
#[error("{what}: {field}: expected {expected}, found {found}")]
pub struct InputError {
    /// Which message.
    pub what: &'static str,
    /// Which field.
    pub field: String,
    /// What it must be.
    pub expected: String,
    /// What it is.
    pub found: String,
}
