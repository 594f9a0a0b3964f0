//! Model bundles: manifest, digests, golden pair, ONNX Runtime sessions, stages.

mod bundle;
mod golden;
mod graph;
mod manifest;
mod runtime;

pub use bundle::{Bundle, BundleError};
pub use golden::Golden;
pub use graph::Graph;
pub use manifest::{
    Accuracy, Content, CorrelationStage, Crop, CropShape, FileRef, InputSpec, Lookup, Manifest, MatcherStage, Provenance, Resize,
    StageManifest,
};
pub use runtime::{Provider, Runtime, RuntimeError};
