//! `nightfix replay`: a recorded flight through the localizer; `fixes.jsonl`, `metrics.json`, thresholds.

use super::{Common, Outcome, UsageError};
use crate::config::Settings;
use crate::flight::{Flight, ReplayLine, ReplayReport, Thresholds, replay};
use crate::locate::Localizer;
use crate::map::{GeoTiff, MapCache};
use crate::model::{Bundle, Provider, Runtime};
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
    /// The bundle's folder; else the configuration's.
    #[arg(long, value_name = "DIR")]
    bundle: Option<PathBuf>,
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
    let report = fly(&flight, &mut localizer, tracker, guard, filter, args.out.as_deref())?;
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

fn prepare(common: &Common, args: &Args, settings: &Settings, flight: &Flight) -> Result<(Localizer, Tracker), UsageError> {
    let bundle = args.bundle.as_ref().or(settings.bundle.path.as_ref());
    let bundle =
        bundle.ok_or_else(|| UsageError("replay: expected --bundle or a configuration that names one, found neither".into()))?;
    let map = args.map.as_ref().or(flight.map.as_ref());
    let map = map.ok_or_else(|| UsageError("replay: expected --map or a flight that names its map, found neither".into()))?;
    let map = GeoTiff::open(map).map_err(|e| UsageError::from_error(&e))?;
    let map = MapCache::new(map, settings.map.cache_mib.saturating_mul(1 << 20));
    let onnx = &settings.onnxruntime;
    let provider: Provider = onnx.provider.parse().map_err(|e| UsageError::from_error(&e))?;
    let runtime = Runtime::open(common.onnxruntime.as_deref(), onnx.library.as_deref(), provider, onnx.threads)
        .map_err(|e| UsageError::from_error(&e))?;
    let bundle = Bundle::open(bundle, &runtime).map_err(|e| UsageError::from_error(&e))?;
    let tracker = Tracker::new(settings.track.clone()).with_search_radius_m(bundle.manifest.search_radius_m);
    let localizer = Localizer::new(bundle, map, settings.gates.clone(), settings.budget.clone());
    Ok((localizer.map_err(|e| UsageError::from_error(&e))?, tracker))
}

/// Replays, writing the lines as they come.
fn fly(
    flight: &Flight,
    localizer: &mut Localizer,
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
    let report = replay(flight, localizer, tracker, guard, &mut write);
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
