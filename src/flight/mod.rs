//! Recorded flights: the folder layout, replay, metrics, and the simulator with its procedural world.
//!
//! Simulator, in the order of its work: [`world`] (an invented land and its picture) -> [`night`] (how that ground
//! glows) -> [`sensor`] (what a camera over it records).

pub mod night;
pub mod noise;
pub mod sensor;
pub mod world;

pub use world::{World, WorldOptions, make_world};
