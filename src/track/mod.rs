//! The prior: given from outside or taken from the last fix, its growth with age, the fall-back when lost.

mod tracker;

pub use tracker::{PriorReport, Spread, Tracker};
