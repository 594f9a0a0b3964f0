//! One ONNX graph in one session.

/// A graph.
pub struct Graph {}
