//! One window, one frame: the two stages of the paper, in its order.
//!
//! Reference: Xiao et al., STHN, RA-L 2024, Sec. III. Knows neither map nor geodesy: it ends with a homography from
//! rectified-frame px to window px, both at 1 m/px, the window being the W_S square *without* its margin (the margin only
//! shifts coordinates by `window_margin_m`).

use super::correlate::Correlator;
use super::inputs::{FrameView, WindowView};
use super::stages::{self, Similarity};
use super::{Evidence, StageName};
use crate::homography::{Displacement, Homography, Quad, displacement_of_box};
use crate::model::{Bundle, CropShape, Dim, GraphError, Manifest, StageManifest, Tensor};
use std::time::Instant;

/// Why a pair gave nothing.
#[derive(Debug, thiserror::Error)]
pub enum PairError {
    /// The network gave a number that is not finite, or corners of which no homography comes.
    #[error("{what}: expected finite numbers and a homography, found {found}")]
    NonFinite {
        /// Which output.
        what: &'static str,
        /// What it was.
        found: String,
    },
    /// A graph failed.
    #[error(transparent)]
    Graph(#[from] GraphError),
    /// The yaw is unknown and the bundle cannot search for it.
    #[error("yaw_deg: expected a known yaw ({why}), found none")]
    YawNeeded {
        /// Why it is needed.
        why: &'static str,
    },
}

/// Where to search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Search {
    /// Middle of the search disc, window px.
    pub centre_px: [f64; 2],
    /// Its radius, metres.
    pub radius_m: f64,
    /// The vehicle's place in the rectified frame, px: the disc is about the vehicle.
    pub vehicle_px: [f64; 2],
    /// Whether the frame's yaw is known; else all of the circle is tried.
    pub yaw_known: bool,
    /// Whether the refine stage also sees the frame with parts covered: evidence, for four more frames of its cost.
    pub crops: bool,
}

impl Search {
    /// The whole of D_C about the window's middle with a nadir frame of known yaw: what the golden pair is matched with.
    pub fn whole(manifest: &Manifest) -> Self {
        let middle = |px: usize| (px as f64 - 1.0) / 2.0;
        let (window, frame) = (middle(manifest.window_px()), middle(manifest.frame_px()));
        Self { centre_px: [window; 2], radius_m: manifest.search_radius_m, vehicle_px: [frame; 2], yaw_known: true, crops: false }
    }
}

/// A window's side of the coarse stage: kept while the window stays.
#[derive(Debug)]
pub enum MapSide {
    /// Map features of a matcher.
    Matcher(Tensor),
    /// Map features of a correlation, and their spectrum.
    Correlation(Box<Correlator>),
}

/// What a pair gave.
#[derive(Debug, Clone)]
pub struct PairMatch {
    /// The frame's edges in the window after the coarse stage, window px.
    pub coarse: Quad,
    /// After the last stage, window px.
    pub quad: Quad,
    /// Rectified-frame px -> window px: Eq. (7).
    pub homography: Homography,
    /// The last stage.
    pub stage: StageName,
    /// `quad` as displacement in pixels of the coarse stage's map input (the golden pair's `final`).
    pub final_displacement: Displacement,
    /// Numbers that speak for or against it.
    pub evidence: Evidence,
}

/// Milliseconds by step.
pub struct Steps {
    last: Instant,
    /// Names and milliseconds, in order.
    pub taken: Vec<(&'static str, f64)>,
}

impl Steps {
    /// Starts the clock.
    pub fn start() -> Self {
        Self { last: Instant::now(), taken: Vec::new() }
    }
    /// The step that ends now.
    pub fn done(&mut self, name: &'static str) {
        let now = Instant::now();
        self.taken.push((name, (now - self.last).as_secs_f64() * 1e3));
        self.last = now;
    }
}

/// Encodes a window for the coarse stage: F_H's map features, Sec. III-B.
pub fn encode_map(bundle: &mut Bundle, window: &WindowView<'_>) -> Result<MapSide, PairError> {
    let manifest = &bundle.manifest;
    // A matcher's map input covers the window, a correlation's also its margin.
    let inset = if matches!(manifest.coarse, StageManifest::Matcher(_)) { manifest.margin_px() } else { 0 };
    let input = window.input(manifest.coarse.map(), inset);
    let mut outputs = bundle.coarse_map.run(&[("map", &input)])?;
    let features = outputs.take("map_features", &[Dim::Exact(1), Dim::Any, Dim::Any, Dim::Any])?;
    if let Some(bad) = features.data.iter().find(|v| !v.is_finite()) {
        return Err(PairError::NonFinite { what: "coarse_map: map_features", found: bad.to_string() });
    }
    Ok(match manifest.coarse {
        StageManifest::Matcher(_) => MapSide::Matcher(features),
        StageManifest::Correlation(_) => MapSide::Correlation(Box::new(Correlator::new(features))),
    })
}

/// Matches a frame with a window (whose coarse features are `map`).
pub fn match_pair(
    bundle: &mut Bundle,
    window: &WindowView<'_>,
    map: &mut MapSide,
    frame: &FrameView<'_>,
    search: &Search,
    steps: &mut Steps,
) -> Result<PairMatch, PairError> {
    let mut evidence = Evidence::new();
    // Coarse: D_RS->RT = F_H(I_RS, I_RT), Eq. (1), (2); or a similarity from a dense correlation.
    let coarse = match map {
        MapSide::Matcher(features) => stages::coarse_matcher(bundle, features, frame, search, &mut evidence, steps)?,
        MapSide::Correlation(correlator) => stages::coarse_correlation(bundle, correlator, frame, search, &mut evidence, steps)?,
    };
    // Refine: the box B round the warped corners, cropped at full resolution, Eq. (4); D_S->T = D_S->B + D_B->T, Eq. (7).
    let crop = match &bundle.manifest.refine {
        Some(StageManifest::Matcher(stage)) => stage.crop,
        _ => None,
    };
    let refined = match crop.map(|crop| crop.shape) {
        None => None,
        Some(CropShape::BoundingBox) => {
            Some(stages::refine_bounding_box(bundle, window, frame, &coarse, search.crops, &mut evidence, steps)?)
        }
        Some(CropShape::Oriented) => {
            Some(stages::refine_oriented(bundle, window, frame, &coarse, search.crops, &mut evidence, steps)?)
        }
    };
    let (quad, stage) = refined.map_or((coarse, StageName::Coarse), |quad| (quad, StageName::Refine));
    // DLT: frame edges to the quad's edges give H; then Eq. (8) for any point of the frame.
    let frame_px = bundle.manifest.frame_px();
    let homography = homography_of(frame_px, &quad)?;
    if stage == StageName::Refine {
        let middle = (frame_px as f64 - 1.0) / 2.0;
        let (before, after) = (homography_of(frame_px, &coarse)?.apply(middle, middle), homography.apply(middle, middle));
        evidence.insert("stage_shift_m".into(), (after[0] - before[0]).hypot(after[1] - before[1]));
    }
    steps.done("dlt");
    let final_displacement = final_displacement(&bundle.manifest, &quad);
    Ok(PairMatch { coarse, quad, homography, stage, final_displacement, evidence })
}

/// The homography that takes the frame's edges to a quad's.
pub(super) fn homography_of(frame_px: usize, quad: &Quad) -> Result<Homography, PairError> {
    let found = |found: String| PairError::NonFinite { what: "corners", found };
    let homography = quad.homography_from(frame_px).map_err(|e| found(e.to_string()))?;
    match homography.0.iter().flatten().find(|v| !v.is_finite()) {
        None => Ok(homography),
        Some(bad) => Err(found(bad.to_string())),
    }
}

/// A quad of window edges as displacement in pixels of the coarse stage's map input, from the identity corners.
fn final_displacement(manifest: &Manifest, quad: &Quad) -> Displacement {
    let spec = manifest.coarse.map();
    // A correlation's map input starts at the margin's corner.
    let margin_m = if matches!(manifest.coarse, StageManifest::Matcher(_)) { 0.0 } else { manifest.window_margin_m };
    let edges = Quad(quad.0.map(|[x, y]| [x + margin_m, y + margin_m]));
    displacement_of_box(&edges, spec.size_px as usize, spec.m_per_px())
}

/// The similarity that a quad of the frame's edges comes closest to: mean of the corners, mean rotation, scale by area.
pub(super) fn similarity_of(frame_px: usize, quad: &Quad) -> Similarity {
    let scale = quad.area_px2().abs().sqrt() / frame_px as f64;
    Similarity { centre_px: quad.mean(), rotation_deg: quad.rotation_deg(), scale }
}
