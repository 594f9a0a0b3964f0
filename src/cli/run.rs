//! `nightfix run`.

use super::{Common, Outcome, UsageError};
use crate::config::Settings;
use std::path::PathBuf;

/// Arguments of `nightfix run`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Configuration: states only what differs from config/nightfix.toml.
    #[arg(long, value_name = "F")]
    config: PathBuf,
}

/// Runs the service until SIGTERM or SIGINT.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let settings = Settings::load(&args.config).map_err(|e| UsageError::from_error(&e))?;
    if !settings.gates.enabled {
        tracing::warn!("gates.enabled = false: fixes that the gates would withhold are published (`withheld` names the gate)");
    }
    match crate::daemon::run(settings, common.onnxruntime.as_deref()) {
        Ok(()) => Ok(Outcome::Done),
        // Not exit code 2, which tells the service manager that another start is of no use.
        Err(error) if error.may_pass() => {
            tracing::error!("{}", UsageError::from_error(&error));
            Ok(Outcome::GateFailed)
        }
        Err(error) => Err(UsageError::from_error(&error)),
    }
}
