//! Recorded flights: the folder layout, replay, metrics, and the simulator with its procedural world.
//!
//! Replay: [`Flight`] (the folder, read strictly) -> [`replay()`] (each row through the localizer) -> [`Metrics`].
//! Simulator, in the order of its work: [`world`] (an invented land and its picture) -> [`night`] (how that ground
//! glows) -> [`sensor`] (what a camera over it records) -> [`simulate()`] (a flight folder with priors and truth).

mod classes;
mod format;
pub(crate) mod ground;
mod metrics;
pub mod night;
pub mod noise;
mod replay;
pub mod sensor;
mod simulate;
pub(crate) mod trajectory;
pub mod world;

pub use format::{Flight, FlightError, Row, RowPrior};
pub use metrics::{ErrorSummary, LatencySummary, Metrics, Tally, Thresholds};
pub use replay::{Locate, ReplayLine, ReplayReport, replay};
pub use simulate::{MapSource, SimulateError, SimulateOptions, SimulateReport, simulate};
pub use trajectory::{Heading, Trajectory};
pub use world::{World, WorldOptions, make_world};
