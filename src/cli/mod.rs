//! The command line: one file per sub-command. Exit codes: 0 done; 1 ran and failed a gate; 2 usage or
//! configuration; 3 finished with data loss. JSON on stdout, logs on stderr.

mod check;
mod contact_sheet;
mod frame;
mod locate;
mod replay;
mod run;
mod schema;
mod simulate;
mod survey;

use clap::{Parser, Subcommand};
use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

/// Night-time position fixes without GNSS: a thermal frame matched against a satellite map.
#[derive(Debug, Parser)]
#[command(name = "nightfix", version)]
struct Cli {
    /// ONNX Runtime's shared library (else: configuration, beside the executable, ../lib/nightfix/).
    #[arg(long, global = true, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the service.
    Run(run::Args),
    /// Check a configuration and all that it names.
    Check(check::Args),
    /// Locate one frame.
    Locate(locate::Args),
    /// Replay a recorded flight.
    Replay(replay::Args),
    /// Render a recorded flight over a map, or over a procedural world.
    Simulate(simulate::Args),
    /// Before the flight: where on this map will fixes work?
    Survey(survey::Args),
    /// Show what the network sees of a frame: decoded, tone-mapped, rectified.
    Frame(frame::Args),
    /// Print the JSON schemas of the messages.
    Schema(schema::Args),
}

/// How a sub-command ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// 0.
    Done,
    /// 1: ran and failed a gate.
    GateFailed,
    /// 3: finished with data loss.
    DataLoss,
}

/// A usage or configuration error: exit 2, its text on stderr.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

impl UsageError {
    /// From any error, with its sources.
    pub fn from_error(error: &dyn std::error::Error) -> Self {
        let mut text = error.to_string();
        let mut source = error.source();
        while let Some(cause) = source {
            text = format!("{text}: {cause}");
            source = cause.source();
        }
        Self(text)
    }
}

/// What all sub-commands share.
#[derive(Debug, Clone)]
pub struct Common {
    /// `--onnxruntime`.
    pub onnxruntime: Option<PathBuf>,
}

/// Parses the arguments and runs the sub-command.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            let code = if error.use_stderr() { 2 } else { 0 };
            let _ = error.print();
            return ExitCode::from(code);
        }
    };
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "info,ort=warn,zenoh=warn".into());
    let colours = std::io::stderr().is_terminal();
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours).with_writer(std::io::stderr).init();
    let common = Common { onnxruntime: cli.onnxruntime };
    let outcome = match cli.command {
        Command::Run(args) => run::run(&common, args),
        Command::Check(args) => check::run(&common, args),
        Command::Locate(args) => locate::run(&common, args),
        Command::Replay(args) => replay::run(&common, args),
        Command::Simulate(args) => simulate::run(&common, args),
        Command::Survey(args) => survey::run(&common, args),
        Command::Frame(args) => frame::run(&common, args),
        Command::Schema(args) => schema::run(&common, args),
    };
    match outcome {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::GateFailed) => ExitCode::from(1),
        Ok(Outcome::DataLoss) => ExitCode::from(3),
        Err(error) => {
            tracing::error!("{error}");
            ExitCode::from(2)
        }
    }
}
