//! Zenoh: session, keys, messages. The contract stands in `message`; schemas in `schemas/` are generated from it.

mod input;
mod keys;
mod message;
mod schema;
mod session;
mod status;

pub use input::{AttitudeMessage, FrameAttachment, InputError, MAX_MESSAGE_BYTES, PriorMessage};
pub use keys::Keys;
pub use message::{FixMessage, LaggedState, LastFixMessage, MapId, PriorEcho, Status, TrackMessage, WindowMessage};
pub use schema::{SCHEMA_NAMES, schema};
pub use session::{BusError, open, zenoh_config};
pub use status::{FrameCounts, InputCounts, State, StatusMessage};
