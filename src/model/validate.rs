//! The manifest's values: every number finite, bounded, and in agreement with the others before anything is allocated.

use super::{
    BundleError, Content, CorrelationStage, CropShape, FileRef, InputSpec, Manifest, MatcherStage, Resize, StageManifest,
};
use crate::thermal::TONE_MAPPING;

/// The manifest layout this version reads.
pub const SCHEMA: u32 = 1;
/// Largest side of an input image, pixels.
const MAX_INPUT_PX: u32 = 4096;
/// Largest side of ground, metres (and pixels, at 1 m/px).
const MAX_WIDTH_M: f64 = 8192.0;
/// Most feature cells along a side of a correlated map: bounds the transform.
const MAX_CELLS: u32 = 1024;
/// Most hypotheses of a correlation stage, turns times scales.
const MAX_HYPOTHESES: usize = 4096;

/// Collects where we are, so that every error names bundle and field.
struct Check<'a> {
    bundle: &'a str,
}

impl Check<'_> {
    fn error(&self, field: &str, expected: impl Into<String>, found: impl std::fmt::Display) -> BundleError {
        BundleError::Field {
            bundle: self.bundle.into(),
            field: field.into(),
            expected: expected.into(),
            found: found.to_string(),
        }
    }
    /// `value` is finite and within `low..=high`.
    fn within(&self, field: &str, value: f64, low: f64, high: f64) -> Result<(), BundleError> {
        if (low..=high).contains(&value) { Ok(()) } else { Err(self.error(field, format!("{low} to {high}"), value)) }
    }
    fn equal(&self, field: &str, value: f64, expected: f64, what: &str) -> Result<(), BundleError> {
        let close = (value - expected).abs() <= 1e-6 * expected.abs().max(1.0);
        if close { Ok(()) } else { Err(self.error(field, format!("{expected} ({what})"), value)) }
    }
    fn whole(&self, field: &str, value: f64) -> Result<(), BundleError> {
        if value.fract() == 0.0 { Ok(()) } else { Err(self.error(field, "a whole number of metres", value)) }
    }
    fn text(&self, field: &str, value: &str) -> Result<(), BundleError> {
        let fine = !value.is_empty() && value.len() <= 4096 && !value.contains('\0');
        if fine { Ok(()) } else { Err(self.error(field, "1 to 4096 characters", format!("{} bytes", value.len()))) }
    }
    /// A plain name in the bundle's own folder and a digest.
    fn file(&self, field: &str, file: &FileRef) -> Result<(), BundleError> {
        let name = &file.file;
        let plain = !name.is_empty() && name.len() <= 255 && !name.starts_with('.') && !name.contains(['/', '\\', '\0', ':']);
        if !plain {
            return Err(self.error(
                &format!("{field}.file"),
                "a file name without separators",
                format!("`{}`", name.escape_debug()),
            ));
        }
        let digest = &file.sha256;
        let hex = digest.len() == 64 && digest.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
        if hex {
            Ok(())
        } else {
            Err(self.error(&format!("{field}.sha256"), "64 lower-case hex digits", format!("`{}`", digest.escape_debug())))
        }
    }
    fn input(&self, field: &str, input: &InputSpec, contents: &[Content], rules: &[Resize]) -> Result<(), BundleError> {
        if !(8..=MAX_INPUT_PX).contains(&input.size_px) {
            return Err(self.error(&format!("{field}.size_px"), format!("8 to {MAX_INPUT_PX}"), input.size_px));
        }
        self.within(&format!("{field}.width_m"), input.width_m, 1.0, MAX_WIDTH_M)?;
        if !contents.contains(&input.content) {
            return Err(self.error(&format!("{field}.content"), format!("one of {contents:?}"), format!("{:?}", input.content)));
        }
        if !rules.contains(&input.resize) {
            return Err(self.error(&format!("{field}.resize"), format!("one of {rules:?}"), format!("{:?}", input.resize)));
        }
        Ok(())
    }
}

const GRAYS: &[Content] = &[Content::Gray, Content::GrayThrice, Content::GrayMask];
const WHOLE: &[Resize] = &[Resize::HalfPixelAntialias, Resize::AlignCornersAntialias];

impl Manifest {
    /// Parses and checks a manifest. `bundle` names it in errors. Unknown fields are errors, with their line.
    pub fn parse(text: &str, bundle: &str) -> Result<Self, BundleError> {
        let manifest: Self = toml::from_str(text).map_err(|e| BundleError::File {
            bundle: bundle.into(),
            file: "bundle.toml".into(),
            why: e.to_string().trim_end().to_owned(),
        })?;
        manifest.check(bundle)?;
        Ok(manifest)
    }

    /// Checks every value; the first that is wrong is named.
    pub fn check(&self, bundle: &str) -> Result<(), BundleError> {
        let c = Check { bundle };
        if self.schema != SCHEMA {
            return Err(c.error("schema", SCHEMA.to_string(), self.schema));
        }
        c.text("name", &self.name)?;
        c.text("licence", &self.licence)?;
        c.text("provenance.description", &self.provenance.description)?;
        if self.tone_mapping != TONE_MAPPING {
            return Err(c.error("tone_mapping", format!("{TONE_MAPPING}, the version of this build"), self.tone_mapping));
        }
        // Homographies are stated between squares at 1 m/px: see the message contract.
        c.equal("m_per_px", self.m_per_px, 1.0, "windows and rectified frames are at 1 m/px")?;
        c.within("window_width_m", self.window_width_m, 64.0, MAX_WIDTH_M)?;
        c.within("window_margin_m", self.window_margin_m, 0.0, 1024.0)?;
        c.within("frame_width_m", self.frame_width_m, 64.0, self.window_width_m)?;
        for (field, value) in [
            ("window_width_m", self.window_width_m),
            ("window_margin_m", self.window_margin_m),
            ("frame_width_m", self.frame_width_m),
        ] {
            c.whole(field, value)?;
        }
        c.within("search_radius_m", self.search_radius_m, 1.0, self.window_width_m)?;
        c.file("golden", &self.golden)?;
        match &self.coarse {
            StageManifest::Matcher(stage) => self.check_matcher(&c, "coarse", stage)?,
            StageManifest::Correlation(stage) => self.check_correlation(&c, stage)?,
        }
        match &self.refine {
            None => {}
            Some(StageManifest::Matcher(stage)) => self.check_matcher(&c, "refine", stage)?,
            Some(StageManifest::Correlation(_)) => return Err(c.error("refine.kind", "matcher", "correlation")),
        }
        if let Some([least, most]) = self.scale_range {
            c.within("scale_range[0]", least, 0.01, 1.0)?;
            c.within("scale_range[1]", most, 1.0, 100.0)?;
        }
        if let Some((field, expected, found)) = self.integrity.as_ref().and_then(super::Integrity::fault) {
            return Err(c.error(&format!("integrity.{field}"), expected, found));
        }
        Ok(())
    }

    fn check_matcher(&self, c: &Check<'_>, name: &str, stage: &MatcherStage) -> Result<(), BundleError> {
        c.file(&format!("{name}.map_graph"), &stage.map_graph)?;
        c.file(&format!("{name}.graph"), &stage.graph)?;
        c.input(&format!("{name}.frame"), &stage.frame, GRAYS, WHOLE)?;
        c.equal(&format!("{name}.frame.width_m"), stage.frame.width_m, self.frame_width_m, "frame_width_m")?;
        c.within(&format!("{name}.tolerance_px"), stage.tolerance_px, 1e-9, 1.0)?;
        c.within(&format!("{name}.match_sigma_m"), stage.match_sigma_m, 1e-3, 1e4)?;
        let (map, width) = (format!("{name}.map"), format!("{name}.map.width_m"));
        match (&stage.crop, name) {
            (None, "coarse") => {
                c.input(&map, &stage.map, &[Content::Rgb], WHOLE)?;
                c.equal(&width, stage.map.width_m, self.window_width_m, "window_width_m")
            }
            (Some(_), "coarse") => Err(c.error("coarse.crop", "none: a coarse stage sees the window", "a crop")),
            (None, _) => Err(c.error(&format!("{name}.crop"), "a crop", "none")),
            (Some(crop), _) => {
                c.within(&format!("{name}.crop.padding_m"), crop.padding_m, 0.0, MAX_WIDTH_M)?;
                let rule = match crop.shape {
                    CropShape::BoundingBox => Resize::AlignCornersBilinear,
                    CropShape::Oriented => Resize::Supersample,
                };
                c.input(&map, &stage.map, &[Content::Rgb], &[rule])?;
                if crop.shape == CropShape::Oriented {
                    let square_m = self.frame_width_m + 2.0 * crop.padding_m;
                    c.equal(&width, stage.map.width_m, square_m, "frame_width_m + 2 padding_m")?;
                }
                Ok(())
            }
        }
    }

    fn check_correlation(&self, c: &Check<'_>, stage: &CorrelationStage) -> Result<(), BundleError> {
        c.file("coarse.map_graph", &stage.map_graph)?;
        c.file("coarse.graph", &stage.graph)?;
        c.input("coarse.map", &stage.map, &[Content::Rgb], WHOLE)?;
        c.input("coarse.frame", &stage.frame, GRAYS, &[Resize::HalfPixelAntialias])?;
        let covered_m = self.window_width_m + 2.0 * self.window_margin_m;
        c.equal("coarse.map.width_m", stage.map.width_m, covered_m, "window_width_m + 2 window_margin_m")?;
        c.equal("coarse.frame.width_m", stage.frame.width_m, self.frame_width_m, "frame_width_m")?;
        let (map_m_per_px, frame_m_per_px) = (stage.map.m_per_px(), stage.frame.m_per_px());
        c.equal("coarse.frame.size_px", frame_m_per_px, map_m_per_px, "metres per pixel of coarse.map")?;
        if !(1..=32).contains(&stage.stride) || stage.frame.size_px % stage.stride != 0 || stage.map.size_px % stage.stride != 0 {
            return Err(c.error("coarse.stride", "1 to 32 and a divisor of both inputs' size_px", stage.stride));
        }
        let cells = stage.map.size_px / stage.stride;
        if cells > MAX_CELLS || stage.frame.size_px / stage.stride > cells {
            return Err(c.error(
                "coarse.map.size_px",
                format!("at most {MAX_CELLS} strides, at least coarse.frame's"),
                stage.map.size_px,
            ));
        }
        let (turns, scales) = (&stage.rotations_deg, &stage.scales);
        if turns.is_empty() || scales.is_empty() || turns.len().saturating_mul(scales.len()) > MAX_HYPOTHESES {
            let found = format!("{} x {}", turns.len(), scales.len());
            return Err(c.error("coarse.rotations_deg x coarse.scales", format!("1 to {MAX_HYPOTHESES} hypotheses"), found));
        }
        for turn in turns {
            c.within("coarse.rotations_deg", *turn, -180.0, 180.0)?;
        }
        for scale in scales {
            c.within("coarse.scales", *scale, 0.25, 4.0)?;
        }
        if stage.subcell_radius > 8 {
            return Err(c.error("coarse.subcell_radius", "0 to 8", stage.subcell_radius));
        }
        c.within("coarse.tolerance", stage.tolerance, 1e-9, 1.0)?;
        c.within("coarse.match_sigma_m", stage.match_sigma_m, 1e-3, 1e4)
    }

    /// Side of the window, pixels (1 m/px).
    pub fn window_px(&self) -> usize {
        self.window_width_m.max(0.0) as usize
    }

    /// Map beyond the window on each side, pixels.
    pub fn margin_px(&self) -> usize {
        self.window_margin_m.max(0.0) as usize
    }

    /// Side of the rectified frame, pixels.
    pub fn frame_px(&self) -> usize {
        self.frame_width_m.max(0.0) as usize
    }
}

impl InputSpec {
    /// Ground metres per input pixel.
    pub fn m_per_px(&self) -> f64 {
        self.width_m / f64::from(self.size_px)
    }
}

impl Content {
    /// Channels of an input of this content.
    pub fn channels(self) -> usize {
        match self {
            Self::Rgb | Self::GrayThrice => 3,
            Self::Gray => 1,
            Self::GrayMask => 2,
        }
    }
}

impl StageManifest {
    /// The map encoder's file.
    pub fn map_graph(&self) -> &FileRef {
        match self {
            Self::Matcher(stage) => &stage.map_graph,
            Self::Correlation(stage) => &stage.map_graph,
        }
    }
    /// The second graph's file.
    pub fn graph(&self) -> &FileRef {
        match self {
            Self::Matcher(stage) => &stage.graph,
            Self::Correlation(stage) => &stage.graph,
        }
    }
    /// The map input.
    pub fn map(&self) -> &InputSpec {
        match self {
            Self::Matcher(stage) => &stage.map,
            Self::Correlation(stage) => &stage.map,
        }
    }
    /// The frame input.
    pub fn frame(&self) -> &InputSpec {
        match self {
            Self::Matcher(stage) => &stage.frame,
            Self::Correlation(stage) => &stage.frame,
        }
    }
    /// Largest difference from the golden outputs.
    pub fn tolerance(&self) -> f64 {
        match self {
            Self::Matcher(stage) => stage.tolerance_px,
            Self::Correlation(stage) => stage.tolerance,
        }
    }
    /// 1-sigma per axis of the stage's match error on validation, metres.
    pub fn match_sigma_m(&self) -> f64 {
        match self {
            Self::Matcher(stage) => stage.match_sigma_m,
            Self::Correlation(stage) => stage.match_sigma_m,
        }
    }
}
