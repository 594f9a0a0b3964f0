//! The localizer: a bundle, a map and settings; queries in, answers out.

use super::{Answer, Query};
use crate::config::{BudgetSettings, GateSettings};
use crate::map::MapCache;
use crate::model::Bundle;

/// What can be wrong when a localizer is put together (never while it answers).
#[derive(Debug, thiserror::Error)]
pub enum LocateError {
    /// The bundle states something this version cannot serve.
    #[error("bundle `{bundle}`: {field}: expected {expected}, found {found}")]
    Bundle {
        /// Bundle name.
        bundle: String,
        /// Manifest field.
        field: &'static str,
        /// What is served.
        expected: String,
        /// What it says.
        found: String,
    },
}

/// Answers queries about one map with one bundle.
pub struct Localizer {}

impl Localizer {
    /// Puts one together.
    pub fn new(bundle: Bundle, map: MapCache, gates: GateSettings, budget: BudgetSettings) -> Result<Self, LocateError> {
        let _ = (bundle, map, gates, budget);
        todo!("locate")
    }
    /// Where was the vehicle? Never panics on any frame, pose or prior. `&mut` only for caches: the answer does not
    /// depend on earlier queries.
    pub fn locate(&mut self, query: &Query<'_>) -> Answer {
        let _ = query;
        todo!("locate")
    }
    /// The bundle.
    pub fn bundle(&self) -> &Bundle {
        todo!("locate")
    }
    /// The map's file name and digest, for messages.
    pub fn map_id(&self) -> (String, String) {
        todo!("locate")
    }
}
