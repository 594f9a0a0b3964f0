//! `nightfix schema`.

use super::{Common, Outcome, UsageError};
use crate::bus::{SCHEMA_NAMES, schema};
use std::io::Write;

/// Arguments of `nightfix schema`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Message: attitude, fix, frame, prior or status. Without it: one object with all of them by name.
    name: Option<String>,
}

/// Prints one schema, or all.
pub fn run(_common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let text = match &args.name {
        Some(name) => schema(name)
            .ok_or_else(|| UsageError(format!("schema: expected one of {}, found `{name}`", SCHEMA_NAMES.join(", "))))?,
        None => {
            let all: Vec<String> =
                SCHEMA_NAMES.iter().filter_map(|name| Some(format!("\"{name}\": {}", schema(name)?))).collect();
            format!("{{\n{}}}\n", all.join(","))
        }
    };
    std::io::stdout().write_all(text.as_bytes()).map_err(|e| UsageError(format!("standard output: {e}")))?;
    Ok(Outcome::Done)
}
