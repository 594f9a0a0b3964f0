//! `nightfix replay`: a recorded flight through the localizer; `fixes.jsonl`, `metrics.json`, thresholds.

use super::{Common, Outcome, UsageError};
use crate::config::{BudgetSettings, MAX_SEARCH_RADIUS_M, Settings};
use crate::daemon::equip;
use crate::flight::{Flight, ReplayLine, ReplayReport, Thresholds, replay};
use crate::locate::Ladder;
use crate::track::{Guard, TrackFilter, Tracker};
use std::io::{BufWriter, IsTerminal, Write};
use std::path::{Path, PathBuf};

/// Whether gates close.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Gates {
    /// As configured.
    On,
    /// Only what has no answer at all is "no fix".
    Off,
}

/// Arguments of `nightfix replay`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The flight's folder.
    flight: PathBuf,
    /// The map; else the one that `flight.toml` names.
    #[arg(long, value_name = "TIF")]
    map: Option<PathBuf>,
    /// The bundle's folder; else the configuration's. Several make a ladder: the smallest whose D_C covers the prior answers.
    #[arg(long, value_name = "DIR", value_delimiter = ',')]
    bundle: Vec<PathBuf>,
    /// Priors wider than the largest D_C are searched up to this radius, metres [default: the configuration's, which is
    /// 0: not at all].
    #[arg(long, value_name = "M")]
    search_radius_m: Option<f64>,
    /// Where `fixes.jsonl` and `metrics.json` go (made if absent), and `track.jsonl` where the configuration asks for the
    /// track. The metrics are printed in any case.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Configuration: bundle, provider, gates, tracking and error budget.
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
    /// `off`: every frame is answered that has an answer.
    #[arg(long, value_enum, default_value_t = Gates::On)]
    gates: Gates,
    /// Least coverage, else exit 1.
    #[arg(long, value_name = "SHARE")]
    min_coverage: Option<f64>,
    /// Largest median error in metres, else exit 1.
    #[arg(long, value_name = "M")]
    max_median_m: Option<f64>,
    /// Largest fraction of scored fixes above 50 m, else exit 1.
    #[arg(long, value_name = "SHARE")]
    max_over_50m: Option<f64>,
}

/// Runs it: 1 where a threshold failed, else 3 where a frame was unreadable.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let mut settings = match &args.config {
        Some(file) => Settings::load(file),
        None => Settings::defaults(),
    }
    .map_err(|e| UsageError::from_error(&e))?;
    settings.gates.enabled &= args.gates == Gates::On;
    let flight = Flight::open(&args.flight).map_err(|e| UsageError::from_error(&e))?;
    for warning in &flight.warnings {
        tracing::warn!("{warning}");
    }
    let (mut localizer, tracker) = prepare(common, &args, &settings, &flight)?;
    let guard = Guard::new(settings.track.clone(), settings.gates.enabled);
    let filter = settings.track.publish_track.then(|| TrackFilter::new(settings.track.clone()));
    let report = fly(&flight, &mut localizer, &settings.budget, tracker, guard, filter, args.out.as_deref())?;
    let text = serde_json::to_string_pretty(&report.metrics).map_err(|e| UsageError::from_error(&e))?;
    if let Some(folder) = &args.out {
        let path = folder.join("metrics.json");
        std::fs::write(&path, format!("{text}\n")).map_err(|e| file_error(&path, &e))?;
    }
    writeln!(std::io::stdout(), "{text}").map_err(|e| UsageError(format!("standard output: {e}")))?;

    let thresholds =
        Thresholds { min_coverage: args.min_coverage, max_median_m: args.max_median_m, max_over_50m: args.max_over_50m };
    let failures = thresholds.failures(&report.metrics);
    for failure in &failures {
        tracing::error!("threshold failed: {failure}");
    }
    if report.unreadable > 0 {
        tracing::error!("{} of {} frames could not be read", report.unreadable, report.metrics.frames);
    }
    Ok(match (failures.is_empty(), report.unreadable) {
        (false, _) => Outcome::GateFailed,
        (true, 0) => Outcome::Done,
        (true, _) => Outcome::DataLoss,
    })
}

/// What the flight is replayed with: paths of the command line go before those of the configuration.
fn prepare(common: &Common, args: &Args, settings: &Settings, flight: &Flight) -> Result<(Ladder, Tracker), UsageError> {
    let mut settings = settings.clone();
    if let [first, further @ ..] = args.bundle.as_slice() {
        (settings.bundle.path, settings.bundle.ladder) = (Some(first.clone()), further.to_vec());
    }
    if settings.bundle.path.is_none() {
        return Err(UsageError("replay: expected --bundle or a configuration that names one, found neither".into()));
    }
    settings.map.path = args.map.clone().or_else(|| flight.map.clone());
    if settings.map.path.is_none() {
        return Err(UsageError("replay: expected --map or a flight that names its map, found neither".into()));
    }
    if let Some(radius_m) = args.search_radius_m {
        if !(0.0..=MAX_SEARCH_RADIUS_M).contains(&radius_m) {
            return Err(UsageError(format!("--search-radius-m: expected 0 to {MAX_SEARCH_RADIUS_M}, found {radius_m}")));
        }
        settings.search.max_radius_m = radius_m;
    }
    let equipment = equip(&settings, common.onnxruntime.as_deref(), &|_| ()).map_err(|e| UsageError::from_error(&e))?;
    let ladder = equipment.localizer;
    let tracker = Tracker::new(settings.track.clone()).with_search_radius_m(ladder.largest().search_radius_m());
    Ok((ladder, tracker))
}

/// Replays, writing the lines as they come.
fn fly(
    flight: &Flight,
    localizer: &mut Ladder,
    budget: &BudgetSettings,
    tracker: Tracker,
    guard: Guard,
    mut filter: Option<TrackFilter>,
    out: Option<&Path>,
) -> Result<ReplayReport, UsageError> {
    let path = out.map(|folder| folder.join("fixes.jsonl"));
    let track_path = out.filter(|_| filter.is_some()).map(|folder| folder.join("track.jsonl"));
    if let Some(folder) = out {
        std::fs::create_dir_all(folder).map_err(|e| file_error(folder, &e))?;
    }
    let create = |path: &Option<PathBuf>| {
        let file = path.as_ref().map(|path| std::fs::File::create(path).map_err(|e| file_error(path, &e)));
        file.transpose().map(|file| file.map(BufWriter::new))
    };
    let (mut file, mut track) = (create(&path)?, create(&track_path)?);
    let bar = std::io::stderr().is_terminal().then(|| indicatif::ProgressBar::new(flight.rows.len() as u64));
    let mut write = |line: &ReplayLine| -> std::io::Result<()> {
        if let Some(bar) = &bar {
            bar.inc(1);
        }
        if let (Some(track), Some(state)) = (&mut track, filter.as_mut().and_then(|filter| filter.take(&line.message))) {
            serde_json::to_writer(&mut *track, &state)?;
            track.write_all(b"\n")?;
        }
        let Some(file) = &mut file else { return Ok(()) };
        serde_json::to_writer(&mut *file, line)?;
        file.write_all(b"\n")
    };
    let report = replay(flight, localizer, budget, tracker, guard, &mut write);
    if let Some(bar) = &bar {
        bar.finish_and_clear();
    }
    let flushed = [&mut file, &mut track].into_iter().flatten().try_for_each(Write::flush);
    let target = path.unwrap_or_default();
    let report = report.map_err(|e| file_error(&target, &e))?;
    flushed.map_err(|e| file_error(&target, &e))?;
    Ok(report)
}

fn file_error(path: &Path, error: &std::io::Error) -> UsageError {
    UsageError(format!("replay: `{}`: {error}", path.display()))
}
