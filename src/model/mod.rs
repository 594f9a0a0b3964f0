//! Model bundles: manifest, digests, golden pair, ONNX Runtime sessions, stages.
//!
//! A bundle is untrusted input: sizes are bounded before anything is allocated, files are plain files in its own folder,
//! and the bytes whose digest was checked are the bytes that run.

mod bundle;
mod file;
mod golden;
mod graph;
mod integrity;
mod manifest;
mod npy;
mod runtime;
mod selfcheck;
mod validate;

pub use bundle::{Bundle, BundleError, GoldenDifference};
pub use golden::Golden;
pub use graph::{Dim, Graph, GraphError, Outputs, Port, Tensor};
pub use integrity::{Cue, Integrity, Judgement, Knots, MissingCue, Sigma, Transform};
pub use manifest::{
    Accuracy, Content, CorrelationStage, Crop, CropShape, FileRef, InputSpec, Lookup, Manifest, MatcherStage, Provenance, Resize,
    StageManifest,
};
pub use runtime::{Provider, Runtime, RuntimeError, find_library};
pub use selfcheck::PIPELINE_TOLERANCE_PX;
pub use validate::SCHEMA;
