//! The prior: given from outside or taken from the last fix, its growth with age, the fall-back when lost. And the guard:
//! is an answer consistent with those before it? Beside the
//! fixes, where it is asked for: a smoothed track.

mod filter;
mod guard;
mod recent;
mod tracker;

pub use filter::TrackFilter;
pub use guard::Guard;
pub(crate) use recent::Recent;
pub use tracker::{PriorReport, Spread, Tracker};
