//! A bundle, opened: manifest checked, digests checked, sessions made, golden pair run.

use super::file::{MAX_GRAPH_BYTES, MAX_MANIFEST_BYTES, read_bounded, read_checked};
use super::golden::{Golden, MAX_GOLDEN_BYTES};
use super::graph::{Dim, Port};
use super::{Graph, GraphError, InputSpec, Manifest, Runtime, StageManifest, selfcheck};
use std::path::Path;

/// What can be wrong with a bundle: refused at start, with the field named.
#[derive(Debug, thiserror::Error)]
pub enum BundleError {
    /// A file is missing or unreadable.
    #[error("bundle `{bundle}`: {file}: {why}")]
    File {
        /// Folder.
        bundle: String,
        /// File in it.
        file: String,
        /// The cause.
        why: String,
    },
    /// A field is missing, unknown or not what it must be.
    #[error("bundle `{bundle}`: {field}: expected {expected}, found {found}")]
    Field {
        /// Folder.
        bundle: String,
        /// Manifest field, graph input or golden array.
        field: String,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A graph is not what the manifest says, or fails.
    #[error("bundle `{bundle}`: {source}")]
    Graph {
        /// Folder.
        bundle: String,
        /// What is wrong.
        source: GraphError,
    },
}

/// An opened bundle.
#[derive(Debug)]
pub struct Bundle {
    /// Its manifest.
    pub manifest: Manifest,
    /// Coarse map encoder.
    pub coarse_map: Graph,
    /// Coarse matcher or frame encoder.
    pub coarse: Graph,
    /// Refine map encoder and matcher.
    pub refine: Option<(Graph, Graph)>,
    /// What the golden pair gave at start-up: largest difference per array, and its bound.
    pub golden: Vec<GoldenDifference>,
}

/// One comparison with the golden pair.
#[derive(Debug, Clone, PartialEq)]
pub struct GoldenDifference {
    /// Array of `golden.npz`.
    pub array: String,
    /// Largest absolute difference.
    pub difference: f64,
    /// Largest allowed.
    pub tolerance: f64,
}

impl Bundle {
    /// Opens a bundle and checks all of it: manifest, digests, graph inputs and outputs, golden pair.
    pub fn open(folder: &Path, runtime: &Runtime) -> Result<Self, BundleError> {
        let (mut bundle, golden) = Self::open_unproven(folder, runtime)?;
        bundle.golden = selfcheck::run(&mut bundle, &golden, &folder.display().to_string())?;
        for line in &bundle.golden {
            tracing::debug!(array = line.array, difference = line.difference, tolerance = line.tolerance, "golden pair");
        }
        tracing::info!(
            bundle = bundle.manifest.name,
            provider = runtime.provider().name(),
            "bundle opened, golden pair reproduced"
        );
        Ok(bundle)
    }

    /// All but running the golden pair.
    pub(super) fn open_unproven(folder: &Path, runtime: &Runtime) -> Result<(Self, Golden), BundleError> {
        let name = folder.display().to_string();
        let text = read_bounded(folder, "bundle.toml", MAX_MANIFEST_BYTES)?;
        let text = String::from_utf8(text).map_err(|e| BundleError::File {
            bundle: name.clone(),
            file: "bundle.toml".into(),
            why: format!("expected UTF-8: {e}"),
        })?;
        let manifest = Manifest::parse(&text, &name)?;
        let golden = read_checked(folder, "golden", &manifest.golden, MAX_GOLDEN_BYTES)?;
        let golden = Golden::read(&golden, &name, manifest.window_px() + 2 * manifest.margin_px(), manifest.frame_px())?;
        let (coarse_map, coarse) = open_stage(folder, runtime, ["coarse_map", "coarse"], &manifest.coarse)?;
        let refine = match &manifest.refine {
            None => None,
            Some(stage) => Some(open_stage(folder, runtime, ["refine_map", "refine"], stage)?),
        };
        Ok((Self { manifest, coarse_map, coarse, refine, golden: Vec::new() }, golden))
    }

    /// A graph by its name.
    pub(super) fn graph_mut(&mut self, name: &str) -> Option<&mut Graph> {
        match (name, &mut self.refine) {
            ("coarse_map", _) => Some(&mut self.coarse_map),
            ("coarse", _) => Some(&mut self.coarse),
            ("refine_map", Some((map, _))) => Some(map),
            ("refine", Some((_, graph))) => Some(graph),
            _ => None,
        }
    }
}

/// Both graphs of a stage, their doors checked against the manifest.
fn open_stage(
    folder: &Path,
    runtime: &Runtime,
    names: [&'static str; 2],
    stage: &StageManifest,
) -> Result<(Graph, Graph), BundleError> {
    let square = |batch: Dim, input: &InputSpec| {
        let side = Dim::Exact(input.size_px as usize);
        vec![batch, Dim::Exact(input.content.channels()), side, side]
    };
    let one_image = vec![Dim::One, Dim::Any, Dim::Any, Dim::Any];
    let map = Port { name: "map", dims: square(Dim::One, stage.map()) };
    let map_features = Port { name: "map_features", dims: one_image.clone() };
    let (inputs, outputs) = match stage {
        StageManifest::Matcher(_) => {
            let two = Dim::Exact(2);
            let frame = Port { name: "frame", dims: square(Dim::One, stage.frame()) };
            (vec![map_features.clone(), frame], vec![Port { name: "displacement", dims: vec![Dim::One, two, two, two] }])
        }
        StageManifest::Correlation(_) => {
            // All hypotheses go in as one batch.
            let frame = Port { name: "frame", dims: square(Dim::Open, stage.frame()) };
            (vec![frame], vec![Port { name: "frame_features", dims: vec![Dim::Open, Dim::Any, Dim::Any, Dim::Any] }])
        }
    };
    let open = |name: &'static str, file, inputs: &[Port], outputs: &[Port]| {
        let onnx = read_checked(folder, &format!("{name}.onnx"), file, MAX_GRAPH_BYTES)?;
        Graph::new(name, &onnx, runtime, inputs, outputs)
            .map_err(|source| BundleError::Graph { bundle: folder.display().to_string(), source })
    };
    let [map_name, name] = names;
    Ok((open(map_name, stage.map_graph(), &[map], &[map_features])?, open(name, stage.graph(), &inputs, &outputs)?))
}
