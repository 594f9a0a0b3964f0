//! What a localisation takes.

use crate::geo::LatLon;
use crate::thermal::{Encoding, FrameError, Pose};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Who said so.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PriorSource {
    /// A prior from outside: Zenoh, a flight's row, the command line.
    External,
    /// nightfix's own last fix.
    OwnFix,
}

/// Where the vehicle may be, at exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Centre of the search disc.
    pub position: LatLon,
    /// R: radius of the search disc, metres: `radius_m` as given, else 3 x `sigma_m`, grown by age.
    pub radius_m: f64,
    /// 1-sigma per axis, metres, where it was given so (grown by age).
    pub sigma_m: Option<f64>,
    /// Who said so.
    pub source: PriorSource,
    /// How many own fixes deep: 0 for an external prior.
    pub chain: u32,
    /// Age at exposure, seconds, where known.
    pub age_s: Option<f64>,
}

/// A frame's bytes and how to read them.
#[derive(Debug, Clone, Copy)]
pub struct EncodedFrame<'a> {
    /// The bytes.
    pub bytes: &'a [u8],
    /// How to read them.
    pub encoding: Encoding,
    /// Width and height, needed for raw Y16.
    pub size_px: Option<(u32, u32)>,
}

/// One localisation.
#[derive(Debug, Clone)]
pub struct Query<'a> {
    /// Exposure, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// The frame, or why there is none.
    pub frame: Result<EncodedFrame<'a>, FrameError>,
    /// The camera's pose at exposure.
    pub pose: Pose,
    /// The prior, or why there is none (`no_prior` or `stale_prior`).
    pub prior: Result<Prior, super::NoFix>,
}
