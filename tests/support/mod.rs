//! What several test programs share.
#![allow(dead_code, missing_docs, reason = "each program uses a part")]

pub mod bundle;
pub mod map;
pub mod onnx;
