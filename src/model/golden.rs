//! `golden.npz`: one input pair and every output. Read with bounds.

/// The golden pair.
#[derive(Debug, Clone)]
pub struct Golden {}
