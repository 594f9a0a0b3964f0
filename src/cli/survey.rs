//! `nightfix survey`: before the flight: where on this map will fixes work?

use super::{Common, Outcome, UsageError};
use crate::config::Settings;
use crate::daemon::equip;
use crate::survey::{Header, SurveyOptions, survey, write_outputs};
use sha2::{Digest, Sha256};
use std::io::{IsTerminal, Write};
use std::path::PathBuf;

/// Before the flight: where on this map will fixes work? Frames of every cell of a grid are rendered as `simulate` does, each
/// of another night, and located as the service does, with priors, yaw and scale as wrong as said, and attitude, map and time
/// stamps as wrong as `[budget]` states.
///
/// Writes into --out: `survey.tif` (georeferenced; 32-bit floats, a pixel a cell: coverage = fixes / frames, median error m,
/// median stated 95 % radius m; NaN where no whole frame fits or nothing was found), `survey.csv` (the same with counts and
/// reasons), `survey.png` (coverage over the map: red 0, yellow 0.5, green 1), `journal.jsonl`. A short table goes to stdout
/// as JSON. Stopped, the same command goes on where it was; another map, bundle, seed or option in the same folder is an
/// error. What it says holds for simulated nights over this map, not for a map that is out of date.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The map: a GeoTIFF; land cover is `<map>_classes.tif` beside it, else guessed from colour.
    #[arg(long, value_name = "TIF")]
    map: PathBuf,
    /// The bundle's folder.
    #[arg(long, value_name = "DIR")]
    bundle: PathBuf,
    /// Folder of the results (made if absent).
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Configuration: ONNX Runtime, gates and error budget.
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
    /// Side of a cell, metres.
    #[arg(long, default_value_t = 256.0)]
    cell_m: f64,
    /// Frames for each cell, each of another night.
    #[arg(long, value_name = "N", default_value_t = 4)]
    frames_per_cell: usize,
    /// Seed of nights, places, errors, noise. The same seed gives the same bytes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Priors are uniform in the disc of this radius about the truth, metres [default: D_C of the bundle].
    #[arg(long)]
    radius_m: Option<f64>,
    /// Error of the reported yaw, uniform within +-, degrees.
    #[arg(long, default_value_t = 5.0)]
    yaw_noise_deg: f64,
    /// Error of the reported height and metres per pixel, uniform within +-, as a share (0.05 is 5 %).
    #[arg(long, default_value_t = 0.05)]
    scale_noise: f64,
    /// Height above ground, metres.
    #[arg(long, default_value_t = 580.0)]
    agl_m: f64,
    /// Frame width, pixels.
    #[arg(long, default_value_t = 640)]
    width: usize,
    /// Frame height, pixels.
    #[arg(long, default_value_t = 512)]
    height: usize,
    /// Horizontal field of view, degrees.
    #[arg(long, default_value_t = 69.2)]
    hfov_deg: f64,
}

/// Runs it.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let usage = |e: &dyn std::error::Error| UsageError::from_error(e);
    let settings = match &args.config {
        Some(file) => Settings::load(file),
        None => Settings::defaults(),
    };
    let mut settings = settings.map_err(|e| usage(&e))?;
    settings.map.path = Some(args.map.clone());
    settings.bundle.path = Some(args.bundle.clone());
    // One bundle at a time: what its fixes are worth here.
    settings.bundle.ladder.clear();
    let equipment = equip(&settings, common.onnxruntime.as_deref(), &|_| ()).map_err(|e| usage(&e))?;
    let mut localizer = equipment.localizer.into_largest();

    let manifest_path = args.bundle.join("bundle.toml");
    let manifest = std::fs::read(&manifest_path);
    let manifest = manifest.map_err(|e| UsageError(format!("survey: `{}`: {e}", manifest_path.display())))?;
    let judged_by = serde_json::to_vec(&(&settings.gates, &settings.budget)).map_err(|e| usage(&e))?;
    let header = Header {
        schema: crate::survey::SCHEMA,
        map: equipment.map.name,
        map_digest: equipment.map.digest,
        bundle: localizer.bundle().manifest.name.clone(),
        bundle_digest: hex(&manifest),
        settings_digest: hex(&judged_by),
        options: SurveyOptions {
            cell_m: args.cell_m,
            frames_per_cell: args.frames_per_cell,
            seed: args.seed,
            radius_m: args.radius_m.unwrap_or(localizer.bundle().manifest.search_radius_m),
            yaw_noise_deg: args.yaw_noise_deg,
            scale_noise: args.scale_noise,
            agl_m: args.agl_m,
            width: args.width,
            height: args.height,
            hfov_deg: args.hfov_deg,
        },
    };
    let bar = std::io::stderr().is_terminal().then(|| {
        let style = indicatif::ProgressStyle::with_template("{wide_bar} {pos}/{len} cells, {eta} left");
        let bar = indicatif::ProgressBar::new(0);
        style.map_or_else(|_| bar.clone(), |style| bar.clone().with_style(style))
    });
    let found = survey(&args.map, &mut localizer, &header, &args.out, |done, total| {
        if let Some(bar) = &bar {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
        }
    });
    if let Some(bar) = bar {
        bar.finish_and_clear();
    }
    let summary = write_outputs(&found.map_err(|e| usage(&e))?, &args.map, &args.out).map_err(|e| usage(&e))?;
    let text = serde_json::to_string_pretty(&summary).map_err(|e| usage(&e))?;
    writeln!(std::io::stdout(), "{text}").map_err(|e| usage(&e))?;
    Ok(Outcome::Done)
}

fn hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
