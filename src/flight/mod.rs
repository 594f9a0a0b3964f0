//! Recorded flights: the folder layout, replay, metrics, and the simulator with its procedural world.

// mod format;
// mod metrics;
// mod replay;
// mod simulate;
// mod world;

// pub use format::{Flight, FlightError, Row};
// pub use metrics::{ErrorSummary, Metrics};
// pub use replay::{ReplayOptions, ReplayReport, replay};
// pub use simulate::{SimulateOptions, simulate};
// pub use world::{WorldOptions, make_world};
