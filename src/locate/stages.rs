//! The stages themselves: inputs, graph, corners. All corners leave as the frame's *edges* in window px.

use super::Evidence;
use super::correlate::{Correlator, ShiftRange};
use super::crops;
use super::cycle::cycle;
use super::hypotheses::{Turner, batch, hypotheses};
use super::inputs::{FrameView, WindowView};
use super::pair::{PairError, Search, Steps, similarity_of};
use super::posterior::{Peak, Surface};
use super::resample::{crop_bilinear, sample_grid};
use crate::homography::{Displacement, Quad, box_of_inclusive};
use crate::model::{Bundle, CorrelationStage, Dim, Graph, Manifest, MatcherStage, Outputs, StageManifest, Tensor};

/// Most hypotheses encoded at once: bounds memory when all of the circle is tried.
pub const MAX_BATCH: usize = 32;

/// Centre, rotation and scale of the frame's square in the window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// The frame's middle, window px.
    pub centre_px: [f64; 2],
    /// Clockwise, degrees.
    pub rotation_deg: f64,
    /// Window metres per frame metre.
    pub scale: f64,
}

impl Similarity {
    /// A point given as offset from the frame's middle (frame px, x right, y down) -> window px.
    pub fn apply(&self, x: f64, y: f64) -> [f64; 2] {
        let (sin, cos) = self.rotation_deg.to_radians().sin_cos();
        let (sin, cos) = (sin * self.scale, cos * self.scale);
        [self.centre_px[0] + cos * x - sin * y, self.centre_px[1] + sin * x + cos * y]
    }

    /// The edges of a frame of this side.
    pub fn quad(&self, frame_px: usize) -> Quad {
        let half = frame_px as f64 / 2.0;
        Quad([[-half, -half], [half, -half], [-half, half], [half, half]].map(|[x, y]| self.apply(x, y)))
    }
}

/// The manifest's matcher stage, where the pipeline has decided that there is one.
fn matcher_of<'a>(stage: Option<&'a StageManifest>, what: &'static str) -> Result<&'a MatcherStage, PairError> {
    match stage {
        Some(StageManifest::Matcher(stage)) => Ok(stage),
        _ => Err(PairError::NonFinite { what, found: "no matcher stage in the manifest".into() }),
    }
}

/// The published kind of coarse stage: map features and frame -> cumulative corner displacements, Eq. (1) and (2).
pub fn coarse_matcher(
    bundle: &mut Bundle,
    features: &Tensor,
    frame: &FrameView<'_>,
    search: &Search,
    evidence: &mut Evidence,
    steps: &mut Steps,
) -> Result<Quad, PairError> {
    if !search.yaw_known {
        return Err(PairError::YawNeeded { why: "a matcher does not search the circle" });
    }
    let stage = matcher_of(Some(&bundle.manifest.coarse), "coarse")?;
    let input = frame.input(&stage.frame);
    steps.done("coarse_input");
    let found = run_matcher(&mut bundle.coarse, features, &input, stage.map.m_per_px(), "coarse", evidence)?;
    let displacement = first(&found, "coarse: displacement")?;
    steps.done("coarse");
    // D' = alpha D, below Eq. (3).
    Ok(box_of_inclusive(&Quad::displaced(stage.map.size_px as usize, &displacement), stage.map.m_per_px()))
}

/// Runs a matcher graph, a displacement for every frame of the batch; evidence is that of the first. `m_per_px` of the map
/// input turns pixels of evidence into metres.
fn run_matcher(
    graph: &mut Graph,
    features: &Tensor,
    frame: &Tensor,
    m_per_px: f64,
    stage: &'static str,
    evidence: &mut Evidence,
) -> Result<Vec<Displacement>, PairError> {
    let mut outputs = graph.run(&[("map_features", features), ("frame", frame)])?;
    let two = Dim::Exact(2);
    let batch = frame.shape.first().copied().unwrap_or(0);
    let tensor = outputs.take("displacement", &[Dim::Exact(batch), two, two, two])?;
    if let Some(bad) = tensor.data.iter().find(|v| !v.is_finite()) {
        return Err(PairError::NonFinite { what: "displacement", found: bad.to_string() });
    }
    let one = |values: &[f32]| {
        let mut displacement = Displacement::default();
        displacement.iter_mut().flatten().flatten().zip(values).for_each(|(to, from)| *to = f64::from(*from));
        displacement
    };
    gather_evidence(&outputs, batch, m_per_px, stage, evidence)?;
    Ok(tensor.data.chunks_exact(8).map(one).collect())
}

/// The first displacement of a batch.
fn first(found: &[Displacement], what: &'static str) -> Result<Displacement, PairError> {
    found.first().copied().ok_or(PairError::NonFinite { what, found: "an empty batch".into() })
}

/// Optional outputs, of the first frame of the batch: `residual` `[B]` (weighted RMS residual of the patches, px), `weight`
/// `[B]` (their total weight), `covariance` `[B, 4, 4]` (of the corner displacements per axis, px^2), `iterations`
/// `[K, B, 2, 2, 2]` (cumulative displacements; the size of the last step tells whether they settled). A number that is not
/// finite is an error: a gate must not miss it.
fn gather_evidence(
    outputs: &Outputs,
    batch: usize,
    m_per_px: f64,
    stage: &str,
    evidence: &mut Evidence,
) -> Result<(), PairError> {
    let mut put = |name: &'static str, value: f64| {
        if !value.is_finite() {
            return Err(PairError::NonFinite { what: name, found: value.to_string() });
        }
        evidence.insert(format!("{stage}_{name}"), value);
        Ok(())
    };
    let per_frame = |name: &str| outputs.get(name).filter(|t| t.data.len() == batch).and_then(|t| t.data.first());
    if let Some(residual) = per_frame("residual") {
        put("residual_m", f64::from(*residual) * m_per_px)?;
    }
    if let Some(weight) = per_frame("weight") {
        put("weight", f64::from(*weight))?;
    }
    if let Some(covariance) = outputs.get("covariance").filter(|t| t.data.len() == 16 * batch) {
        // The middle moves by the mean of the corners: variance 1' C 1 / 16.
        let variance_px2 = covariance.data.iter().take(16).map(|v| f64::from(*v)).sum::<f64>() / 16.0;
        put("match_sigma_m", variance_px2.max(0.0).sqrt() * m_per_px)?;
    }
    let steps = outputs.get("iterations").filter(|t| batch > 0 && t.data.len() % (8 * batch) == 0);
    if let Some(iterations) = steps {
        let mut ends = iterations.data.rchunks_exact(8 * batch);
        if let (Some(end), Some(before)) = (ends.next(), ends.next()) {
            let step = |i: usize| match (end.get(i), before.get(i), end.get(i + 4), before.get(i + 4)) {
                (Some(x1), Some(x0), Some(y1), Some(y0)) => f64::from(x1 - x0).hypot(f64::from(y1 - y0)),
                _ => f64::NAN,
            };
            put("last_step_m", (0..4).map(step).sum::<f64>() / 4.0 * m_per_px)?;
        }
    }
    Ok(())
}

/// The light kind of coarse stage: the frame's features under every hypothesis of yaw and scale, correlated with the
/// map's; the posterior's peak is a similarity.
pub fn coarse_correlation(
    bundle: &mut Bundle,
    correlator: &mut Correlator,
    frame: &FrameView<'_>,
    search: &Search,
    evidence: &mut Evidence,
    steps: &mut Steps,
) -> Result<Quad, PairError> {
    let StageManifest::Correlation(stage) = &bundle.manifest.coarse else {
        return Err(PairError::NonFinite { what: "coarse", found: "no correlation stage in the manifest".into() });
    };
    let geometry = Geometry::new(&bundle.manifest, stage);
    let tried = hypotheses(stage, !search.yaw_known);
    let tried = tried.ok_or(PairError::YawNeeded { why: "the bundle states a single rotation and so no step" })?;
    let disc = |b: usize| tried.get(b).map(|h| geometry.disc_for(search, h.rotation_deg, h.scale));
    let discs: Vec<[f64; 2]> = (0..tried.len()).filter_map(disc).collect();
    let range = geometry.range(&discs, search.radius_m, stage.subcell_radius as usize);
    let turner = Turner::new(frame, stage.frame.size_px as usize);
    let inputs: Vec<Tensor> = tried.chunks(MAX_BATCH).map(|chunk| batch(&turner, stage, chunk)).collect();
    steps.done("coarse_input");
    let mut encoded = Vec::with_capacity(inputs.len());
    for input in &inputs {
        let mut outputs = bundle.coarse.run(&[("frame", input)])?;
        let (channels, cells) = (correlator.map().shape.get(1).copied().unwrap_or(0), geometry.frame_cells);
        let shape = [Dim::Exact(input.shape[0]), Dim::Exact(channels), Dim::Exact(cells), Dim::Exact(cells)];
        encoded.push(outputs.take("frame_features", &shape)?);
    }
    steps.done("coarse");
    let mut logits = Vec::new();
    for features in &encoded {
        let part = correlator.correlate(features, &range);
        logits.extend(part.ok_or_else(|| PairError::NonFinite { what: "correlation", found: format!("{:?}", features.shape) })?);
    }
    let surface = Surface { range, hypotheses: &tried, logits: &logits, subcell_radius: stage.subcell_radius as usize };
    let radius_m = search.radius_m.max(geometry.cell_m * std::f64::consts::FRAC_1_SQRT_2) + 1e-9;
    let peak = surface.peak(|b, dx, dy| {
        let [x, y] = geometry.place([dx as f64, dy as f64]);
        discs.get(b).is_some_and(|disc| (x - disc[0]).hypot(y - disc[1]) <= radius_m)
    });
    let peak = peak.ok_or_else(|| PairError::NonFinite { what: "log-posterior", found: "a logit that is not finite".into() })?;
    steps.done("correlate");
    put_peak(&peak, evidence);
    let features = encoded.get(peak.hypothesis / MAX_BATCH);
    let item = correlator.map().shape.get(1).map_or(0, |channels| channels * geometry.frame_cells * geometry.frame_cells);
    let own = features.and_then(|f| f.data.chunks_exact(item.max(1)).nth(peak.hypothesis % MAX_BATCH));
    if let Some(back) = own.and_then(|own| cycle(correlator.map(), own, geometry.frame_cells, peak.shift)) {
        evidence.insert("cycle_m".into(), back.distance_cells * geometry.cell_m);
        evidence.insert("cycle_mass".into(), back.mass);
    }
    steps.done("cycle");
    let similarity = Similarity { centre_px: geometry.place(peak.shift), rotation_deg: peak.rotation_deg, scale: peak.scale };
    Ok(similarity.quad(bundle.manifest.frame_px()))
}

fn put_peak(peak: &Peak, evidence: &mut Evidence) {
    for (name, value) in [
        ("peak_mass", peak.peak_mass),
        ("second_peak", peak.second_peak),
        ("near_peak", peak.near_peak),
        ("entropy_bits", peak.entropy_bits),
        ("peak_logit", peak.peak_logit),
        ("peak_log_mass", peak.peak_log_mass),
        ("coarse_rotation_deg", peak.rotation_deg),
        ("coarse_scale", peak.scale),
    ] {
        evidence.insert(name.into(), value);
    }
}

/// Between shifts in feature cells and places in window px.
///
/// Frame cell 0 on map cell d lays frame-input pixel p on map-input pixel `p + stride d` (cell i is centred on input pixel
/// `stride i + (stride - 1) / 2` on both sides). The frame's middle, input pixel `(n - 1) / 2`, then lies on map-input pixel
/// `m = (n - 1) / 2 + stride d`, which is window pixel `(m + 0.5) * m_per_px - 0.5 - margin`.
pub struct Geometry {
    stride: f64,
    m_per_px: f64,
    margin_px: f64,
    frame_middle: f64,
    /// Metres from cell to cell.
    pub cell_m: f64,
    /// Cells along a side of the frame's features.
    pub frame_cells: usize,
    rectified_middle: f64,
}

impl Geometry {
    /// Of this stage.
    pub fn new(manifest: &Manifest, stage: &CorrelationStage) -> Self {
        let m_per_px = stage.map.m_per_px();
        Self {
            stride: f64::from(stage.stride),
            m_per_px,
            margin_px: manifest.margin_px() as f64,
            frame_middle: (f64::from(stage.frame.size_px) - 1.0) / 2.0,
            cell_m: f64::from(stage.stride) * m_per_px,
            frame_cells: (stage.frame.size_px / stage.stride.max(1)) as usize,
            rectified_middle: (manifest.frame_px() as f64 - 1.0) / 2.0,
        }
    }

    /// Shift (cells) -> the frame's middle in window px.
    pub fn place(&self, shift: [f64; 2]) -> [f64; 2] {
        shift.map(|d| (self.frame_middle + self.stride * d + 0.5) * self.m_per_px - 0.5 - self.margin_px)
    }

    /// The frame's middle in window px -> shift (cells).
    fn shift(&self, place: f64) -> f64 {
        ((place + 0.5 + self.margin_px) / self.m_per_px - 0.5 - self.frame_middle) / self.stride
    }

    /// The search disc is about the vehicle; this is its middle for the frame's middle, under a hypothesis.
    fn disc_for(&self, search: &Search, rotation_deg: f64, scale: f64) -> [f64; 2] {
        let offset = search.vehicle_px.map(|v| v - self.rectified_middle);
        let turned = Similarity { centre_px: [0.0; 2], rotation_deg, scale }.apply(offset[0], offset[1]);
        [search.centre_px[0] - turned[0], search.centre_px[1] - turned[1]]
    }

    /// Every shift that any disc allows, and the sub-cell square round it.
    fn range(&self, discs: &[[f64; 2]], radius_m: f64, subcell_radius: usize) -> ShiftRange {
        // One cell more for the maxima over 3 x 3 cells, and one for rounding.
        let rim = subcell_radius as i64 + 2;
        let mut range = ShiftRange { from: [0; 2], size: [0; 2] };
        for axis in 0..2 {
            let (low, high) = discs.iter().fold((f64::MAX, f64::MIN), |(l, h), d| (l.min(d[axis]), h.max(d[axis])));
            let from = (self.shift(low - radius_m).floor()).clamp(-1e5, 1e5) as i64 - rim;
            let to = (self.shift(high + radius_m).ceil()).clamp(-1e5, 1e5) as i64 + rim;
            // A disc lies in the window and the vehicle near the frame: never this many in a query that got here.
            range.from[axis] = from;
            range.size[axis] = usize::try_from(to - from + 1).unwrap_or(0).min(1024);
        }
        range
    }
}

/// The published kind of refine stage: the square bounding box of the coarse quad, padded; see `models/sthn/network/two_stage.py`.
pub fn refine_bounding_box(
    bundle: &mut Bundle,
    window: &WindowView<'_>,
    frame: &FrameView<'_>,
    coarse: &Quad,
    crops: bool,
    evidence: &mut Evidence,
    steps: &mut Steps,
) -> Result<Quad, PairError> {
    let stage = matcher_of(bundle.manifest.refine.as_ref(), "refine")?;
    let padding_m = stage.crop.map_or(0.0, |crop| crop.padding_m);
    let margin = bundle.manifest.margin_px() as f64;
    // Edges in metres from the window's corner: pixel + 0.5.
    let bounds = |axis: usize| {
        let (low, high) = coarse.0.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p[axis]), h.max(p[axis])));
        (low + 0.5, high + 0.5)
    };
    let ((left, right), (top, bottom)) = (bounds(0), bounds(1));
    let width = (right - left).max(bottom - top) + 2.0 * padding_m;
    let start = [(left + right) / 2.0 - width / 2.0, (top + bottom) / 2.0 - width / 2.0];
    let n = stage.map.size_px as usize;
    // The published crop takes sample i at start + i (W_B - 1) / (n - 1) as a pixel's centre.
    let step = (width - 1.0) / (n as f64 - 1.0);
    let crop = crop_bilinear(&window.sampler(), start[0] + margin, start[1] + margin, step, n);
    let eta = width / n as f64;
    let quad = refine(bundle, Tensor { shape: vec![1, 3, n, n], data: crop }, frame, eta, crops, evidence, steps)?;
    // D_S->T = D_S->B + eta D_RB->RT, Eq. (7), as edges.
    Ok(Quad(box_of_inclusive(&quad, eta).0.map(|[x, y]| [x + start[0], y + start[1]])))
}

/// The light kind of refine stage: the frame's own square under the coarse similarity, padded, turned and scaled upright,
/// so that what is left to find is small.
///
/// Crop pixel (u, v) of n lies at offset `((u, v) - (n - 1) / 2) * m_per_px` (frame metres) from the frame's middle, and
/// there at the coarse similarity's image in the window.
pub fn refine_oriented(
    bundle: &mut Bundle,
    window: &WindowView<'_>,
    frame: &FrameView<'_>,
    coarse: &Quad,
    crops: bool,
    evidence: &mut Evidence,
    steps: &mut Steps,
) -> Result<Quad, PairError> {
    let stage = matcher_of(bundle.manifest.refine.as_ref(), "refine")?;
    let similarity = similarity_of(bundle.manifest.frame_px(), coarse);
    let (n, m_per_px) = (stage.map.size_px as usize, stage.map.m_per_px());
    let margin = bundle.manifest.margin_px() as f64;
    let middle = (n as f64 - 1.0) / 2.0;
    let place = |u: f64, v: f64| {
        let [x, y] = similarity.apply((u - middle) * m_per_px, (v - middle) * m_per_px);
        [x + margin, y + margin]
    };
    // Nominal, not times the coarse scale: the rule must not change between frames.
    let samples = m_per_px.round_ties_even().clamp(1.0, 16.0) as usize;
    let crop = sample_grid(&window.sampler(), n, samples, place);
    let quad = refine(bundle, Tensor { shape: vec![1, 3, n, n], data: crop }, frame, m_per_px, crops, evidence, steps)?;
    // Edges in crop px at 1 frame metre, then through the similarity: H = similarity after the fine homography.
    let side_middle = n as f64 * m_per_px / 2.0 - 0.5;
    Ok(Quad(box_of_inclusive(&quad, m_per_px).0.map(|[x, y]| similarity.apply(x - side_middle, y - side_middle))))
}

/// Encodes a crop and runs the refine matcher: inclusive corners in crop px. F'_H of Sec. III-C.
fn refine(
    bundle: &mut Bundle,
    crop: Tensor,
    frame: &FrameView<'_>,
    m_per_px: f64,
    with_crops: bool,
    evidence: &mut Evidence,
    steps: &mut Steps,
) -> Result<Quad, PairError> {
    let stage = matcher_of(bundle.manifest.refine.as_ref(), "refine")?;
    steps.done("crop");
    let input = frame.input(&stage.frame);
    steps.done("refine_input");
    let Some((map_graph, graph)) = &mut bundle.refine else {
        return Err(PairError::NonFinite { what: "refine", found: "no graphs".into() });
    };
    let mut outputs = map_graph.run(&[("map", &crop)])?;
    let features = outputs.take("map_features", &[Dim::Exact(1), Dim::Any, Dim::Any, Dim::Any])?;
    steps.done("refine_map");
    let five = with_crops.then(|| crops::batch(&input)).flatten();
    let found = run_matcher(graph, &features, five.as_ref().unwrap_or(&input), m_per_px, "refine", evidence)?;
    let displacement = first(&found, "refine: displacement")?;
    if five.is_some() {
        let spread = crops::spread(&found);
        evidence.insert("crop_spread_m".into(), spread.corners_px * m_per_px);
        evidence.insert("crop_middle_spread_m".into(), spread.middle_px * m_per_px);
    }
    steps.done("refine");
    Ok(Quad::displaced(stage.map.size_px as usize, &displacement))
}
