//! The two-stage pipeline of the paper, in the paper's order, with gates and an error budget.
//!
//! One [`Localizer`] answers every caller. It is synchronous, holds no clock and no network.

mod answer;
mod localizer;
mod query;

pub use answer::{Answer, Evidence, Fix, Latency, NoFix, Reason, StageName, WindowInfo};
pub use localizer::{Localizer, LocateError};
pub use query::{EncodedFrame, Prior, PriorSource, Query};
