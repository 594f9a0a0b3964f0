//! Why the service does not start, or stopped.

use crate::bus::BusError;
use crate::locate::LocateError;
use crate::map::MapError;
use crate::model::{BundleError, RuntimeError};

/// Why the service does not start, or stopped.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    /// A setting that the service cannot do without.
    #[error("configuration: {field}: expected {expected}, found none")]
    Missing {
        /// Dotted key.
        field: &'static str,
        /// What it must be.
        expected: &'static str,
    },
    /// ONNX Runtime.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// Bundle.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// Map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// Bundle, map and settings do not go together.
    #[error(transparent)]
    Locate(#[from] LocateError),
    /// Zenoh.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The system.
    #[error("{action}: {source}")]
    System {
        /// What was being done.
        action: &'static str,
        /// The cause.
        source: std::io::Error,
    },
    /// A part of the running service ended.
    #[error("{part} ended: {why}")]
    Ended {
        /// Which.
        part: &'static str,
        /// As far as is known.
        why: &'static str,
    },
}

impl DaemonError {
    /// Whether the service ran and failed, or met a system that may be better later (exit 1: start it again), rather
    /// than cannot start as it is configured (exit 2).
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::Ended { .. } | Self::Bus(_) | Self::System { .. })
    }
}
