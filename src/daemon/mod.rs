//! The service: one `Ladder` on a thread of its own, Zenoh round it, systemd above it.
//!
//! ```text
//! Zenoh callbacks (intake)  frame ----> slot of one, newest wins ---> inference thread (answer)
//!                           prior ----> Tracker ----------------------^   |
//!                           attitude -> Attitudes --------------------^   v
//!                                         queryable <-- last answer <-- Outbox --> publishing thread --> `fix`
//! tokio task (serve)        signals, `status`, watchdog
//! ```
//!
//! What it promises:
//! * Every frame that comes in is answered exactly once, or counted: `dropped` where a newer one displaced it, `bad`
//!   where not even its stamp could be read. Newest is by arrival: a stamp that repeats or goes back is answered like
//!   any other. A clock that steps forward costs the priors that it makes stale; one that steps back by over a second costs the
//!   priors, fixes and attitudes stamped later than the next one of their kind.
//! * Publishing never holds up localisation; what a stuck peer does not take in time is counted.
//! * The watchdog is pinged while every loop turns and no accepted frame is older than its deadline. Without frames
//!   that holds, so an idle service lives, and says that it is idle.
//! * A panic on a thread ends the process with an exit code that is not 0, so that the service manager starts it anew:
//!   the localizer's caches could be half changed, and a service without its inference thread would be a zombie.

mod answer;
mod attitude;
mod equip;
mod error;
mod health;
mod intake;
mod newest;
mod publish;
mod serve;
mod systemd;
mod throttle;

pub use equip::{Equipment, equip};
pub use error::DaemonError;
pub use serve::run;
