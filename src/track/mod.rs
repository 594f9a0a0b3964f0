//! The prior: given from outside or taken from the last fix, its growth with age, the fall-back when lost. And the guard:
//! is an answer consistent with those before it?

mod guard;
mod recent;
mod tracker;

pub use guard::Guard;
pub(crate) use recent::Recent;
pub use tracker::{PriorReport, Spread, Tracker};
