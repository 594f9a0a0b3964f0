//! `nightfix replay`.

use super::{Common, Outcome, UsageError};

/// Arguments of `nightfix replay`.
#[derive(Debug, clap::Args)]
pub struct Args {}

/// Runs it.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let _ = (common, args);
    Err(UsageError("not built yet".into()))
}
