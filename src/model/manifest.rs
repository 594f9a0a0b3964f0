//! `bundle.toml`: every number needed to feed the graphs. Unknown fields are refused.
//!
//! Graph doors, for both kinds:
//! * `map_graph`: input `map` f32 `[1, 3, Rm, Rm]` in 0..1 -> output `map_features`;
//! * `graph` of a matcher: inputs `map_features`, `frame` f32 `[B, C, Rt, Rt]` -> output `displacement` `[B, 2, 2, 2]`,
//!   optional outputs are evidence;
//! * `graph` of a correlation: input `frame` -> output `frame_features`, already weighted, so that the plain
//!   cross-correlation with `map_features` is a logit.

use super::Integrity;
use serde::{Deserialize, Serialize};

/// A model bundle's manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Layout version: 1.
    pub schema: u32,
    /// Name, also in every fix message.
    pub name: String,
    /// Licence of the weights.
    pub licence: String,
    /// Where the weights come from.
    pub provenance: Provenance,
    /// W_S: side of the search window, metres.
    pub window_width_m: f64,
    /// Map that is read beyond the window on each side, metres: room for crops and turned frames at its rim. 0 where
    /// the network was trained with nothing beyond the window.
    pub window_margin_m: f64,
    /// Side of the frame's square of ground, metres.
    pub frame_width_m: f64,
    /// Ground metres per pixel of window and rectified frame.
    pub m_per_px: f64,
    /// D_C: largest distance of the frame's centre from the window's, metres.
    pub search_radius_m: f64,
    /// Version of the 16-to-8-bit tone mapping the weights were trained with.
    pub tone_mapping: u32,
    /// ONNX opset of the graphs.
    pub opset: u32,
    /// The golden pair.
    pub golden: FileRef,
    /// First stage.
    pub coarse: StageManifest,
    /// Second stage; absent in a one-stage bundle.
    pub refine: Option<StageManifest>,
    /// What was measured, and on what.
    pub accuracy: Option<Accuracy>,
    /// Least and largest factor by which frame, window and D_C may all be scaled together, the pixels staying as many: low
    /// flights over finer maps. Absent: not scaled.
    pub scale_range: Option<[f64; 2]>,
    /// What the evidence is worth; absent: uncalibrated.
    pub integrity: Option<Integrity>,
}

/// Where weights come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// In one sentence.
    pub description: String,
    /// The command that made them.
    pub command: String,
    /// Seed, where they were trained or drawn here.
    pub seed: Option<u64>,
    /// Training data, by name and licence.
    pub data: Vec<String>,
}

/// A file of the bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileRef {
    /// Name inside the bundle's folder, no separators.
    pub file: String,
    /// SHA-256, lower-case hex.
    pub sha256: String,
}

/// One stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum StageManifest {
    /// Two graphs; the second gives corner displacements.
    Matcher(MatcherStage),
    /// Two graphs give features; correlation, posterior and peaks are ours.
    Correlation(CorrelationStage),
}

/// A stage whose second graph gives corner displacements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MatcherStage {
    /// Map encoder.
    pub map_graph: FileRef,
    /// Matcher.
    pub graph: FileRef,
    /// Map input. In a coarse stage it covers the window; in a refine stage, the crop.
    pub map: InputSpec,
    /// Frame input; covers `frame_width_m`.
    pub frame: InputSpec,
    /// Direction of the correlation look-up inside the graph.
    pub lookup: Lookup,
    /// How a refine stage's map crop is cut; absent in a coarse stage.
    pub crop: Option<Crop>,
    /// Largest difference from the golden outputs, stage-input pixels.
    pub tolerance_px: f64,
    /// 1-sigma per axis of the stage's match error on validation, metres.
    pub match_sigma_m: f64,
}

/// A stage of dense correlation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CorrelationStage {
    /// Map encoder; fully convolutional, sizes free in multiples of 4 px.
    pub map_graph: FileRef,
    /// Frame encoder.
    pub graph: FileRef,
    /// Map input; covers the window and its margin.
    pub map: InputSpec,
    /// Frame input; covers `frame_width_m`.
    pub frame: InputSpec,
    /// Input pixels per feature cell: cell i is centred on input pixel `stride * i + (stride - 1) / 2`.
    pub stride: u32,
    /// Yaw hypotheses, degrees: the true yaw is the assumed one plus this.
    pub rotations_deg: Vec<f64>,
    /// Scale hypotheses: the true footprint is the assumed one times this.
    pub scales: Vec<f64>,
    /// Half side of the square of cells of the sub-cell soft-argmax.
    pub subcell_radius: u32,
    /// Largest difference from the golden outputs.
    pub tolerance: f64,
    /// 1-sigma per axis of the stage's match error on validation, metres.
    pub match_sigma_m: f64,
}

/// How an input image is made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputSpec {
    /// Side, pixels.
    pub size_px: u32,
    /// Side of ground it covers, metres (a bounding-box crop: nominal).
    pub width_m: f64,
    /// What its channels hold.
    pub content: Content,
    /// Resampling rule.
    pub resize: Resize,
}

/// What the channels of an input hold, values 0..1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Content {
    /// Three channels, RGB.
    Rgb,
    /// One channel.
    Gray,
    /// One gray value three times, as the published network takes it.
    GrayThrice,
    /// Two channels: gray (0 where unseen) and validity (1 seen, 0 unseen).
    GrayMask,
}

/// Resampling rules.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Resize {
    /// Bilinear, antialias, half-pixel centres (torch `antialias=True, align_corners=False`).
    HalfPixelAntialias,
    /// torch `antialias=True, align_corners=True`: see `models/sthn/network/resize.py`.
    AlignCornersAntialias,
    /// Bilinear between corner pixels, zero outside, no antialias: see `models/sthn/network/two_stage.py`. Crops only.
    AlignCornersBilinear,
    /// Mean of n x n bilinear samples spread evenly over the pixel, n = max(1, round(source pixels per pixel)); for
    /// turned and scaled grids.
    Supersample,
}

/// Direction of the look-up: see `models/sthn/network/correlation.py`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lookup {
    /// Map-indexed at H(p) in the frame: the published one, geometrically inconsistent, needed by released weights.
    Published,
    /// Map-indexed at H^-1(p) in the frame.
    MapIndexed,
    /// Frame-indexed at H(p) in the map.
    FrameIndexed,
}

/// How a refine stage's crop is cut from the window.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Crop {
    /// Which square.
    pub shape: CropShape,
    /// Metres added on each side of it.
    pub padding_m: f64,
}

/// Which square of the window a refine stage sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CropShape {
    /// The axis-aligned bounding box of the coarse quad, made square: paper Sec. III-C, `models/sthn/network/two_stage.py`.
    BoundingBox,
    /// The frame's square under the coarse similarity (its centre, rotation and scale), so that what is left to find
    /// is small.
    Oriented,
}

/// A measured accuracy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accuracy {
    /// On what, with what noise.
    pub data: String,
    /// The command that prints it.
    pub command: String,
    /// Frames.
    pub frames: u64,
    /// Search radius, metres.
    pub search_radius_m: f64,
    /// Fixes per frame.
    pub coverage: f64,
    /// Median centre error, metres.
    pub median_m: f64,
    /// Mean centre error, metres.
    pub mean_m: f64,
    /// 95th percentile of the centre error, metres.
    pub p95_m: f64,
    /// Share above 25 m.
    pub over_25m: f64,
    /// Share above 50 m.
    pub over_50m: f64,
}
