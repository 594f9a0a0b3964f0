//! Finding and loading ONNX Runtime.

/// Execution provider.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Provider {
    /// CPU.
    Cpu,
    /// CUDA.
    Cuda,
    /// TensorRT.
    TensorRt,
    /// XNNPACK.
    Xnnpack,
}

/// ONNX Runtime, loaded.
pub struct Runtime {}

/// Why it is not.
#[derive(Debug, thiserror::Error)]
pub enum RuntimeError {
    /// None found.
    #[error("ONNX Runtime was not found; tried: {tried}")]
    NotFound {
        /// The places, joined.
        tried: String,
    },
}
