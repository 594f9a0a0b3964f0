//! Zenoh: session, keys, messages. The contract stands in `message`; schemas in `schemas/` are generated from it.

mod input;
mod keys;
mod message;
mod session;

pub use input::{AttitudeMessage, FrameAttachment, InputError, PriorMessage};
pub use keys::Keys;
pub use message::{FixMessage, MapId, PriorEcho, Status, WindowMessage};
pub use session::{BusError, open};
