//! The prior: given from outside or taken from the last fix, its growth with age, the fall-back when lost.

mod recent;
mod tracker;

pub(crate) use recent::Recent;
pub use tracker::{PriorReport, Spread, Tracker};
