//! The two-stage pipeline of the paper, in the paper's order, with gates and an error budget.
//!
//! One [`Ladder`] answers every caller. It is synchronous, holds no clock and no network. [`pair`] is the algorithm;
//! [`Localizer`] puts map, geodesy, gates and error budget round it; the ladder holds one per bundle and searches beyond
//! the largest D_C (`search`, `region`).

mod answer;
mod budget;
mod correlate;
mod crops;
mod cues;
mod cycle;
mod gates;
mod hypotheses;
mod inputs;
mod ladder;
mod localizer;
pub mod pair;
mod posterior;
mod query;
mod region;
mod resample;
mod scaled;
mod search;
mod stages;
mod windows;

pub(crate) use budget::{largest_sigma_m, tilt_was_assumed};

pub use answer::{Answer, Evidence, Fix, Latency, NoFix, Reason, StageName, WindowInfo};
pub use inputs::{FrameView, WindowView};
pub use ladder::Ladder;
pub use localizer::{Localizer, LocateError, Seen};
pub use query::{EncodedFrame, Prior, PriorSource, Query};
