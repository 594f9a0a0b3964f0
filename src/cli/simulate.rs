//! `nightfix simulate`: renders a recorded flight over a map, or over a procedural world.

use super::{Common, Outcome, UsageError};
use crate::flight::sensor::Sensor;
use crate::flight::{Heading, MapSource, SimulateOptions, Trajectory, WorldOptions, simulate};
use std::io::{IsTerminal, Write};
use std::path::PathBuf;

/// Arguments of `nightfix simulate`. The defaults give frames that see at least 97 % of the 512 m square at any yaw:
/// 640 x 512 px at 1.25 m/px, 800 x 640 m of ground.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The map: a GeoTIFF.
    #[arg(long, value_name = "TIF", required_unless_present = "world", conflicts_with = "world")]
    map: Option<PathBuf>,
    /// Land cover on the map's grid (else `<map>_classes.tif` beside it, else guessed from colour).
    #[arg(long, value_name = "TIF", requires = "map")]
    classes: Option<PathBuf>,
    /// Make a procedural world from this seed and fly over it.
    #[arg(long, value_name = "SEED")]
    world: Option<u64>,
    /// Side of the procedural world, metres.
    #[arg(long, default_value_t = 4000.0)]
    world_size_m: f64,
    /// Metres per pixel of the procedural world.
    #[arg(long, default_value_t = 1.0)]
    world_m_per_px: f64,
    /// Grain of the procedural world's picture, grey levels.
    #[arg(long, default_value_t = 3.0)]
    world_grain: f64,
    /// Folder of the flight (made if absent; files of the same name are replaced).
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Frames.
    #[arg(long, default_value_t = 60)]
    frames: usize,
    /// Seed of the flight: night, places, errors, noise. The same seed gives the same bytes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// D_C: priors are uniform in the disc of this radius about the truth, metres.
    #[arg(long, default_value_t = 512.0)]
    radius_m: f64,
    /// A prior on every N-th row only; on the others replay uses its own last fix.
    #[arg(long, value_name = "N", default_value_t = 1)]
    prior_every: usize,
    /// Error of the reported yaw, uniform within +-, degrees.
    #[arg(long, default_value_t = 0.0)]
    yaw_noise_deg: f64,
    /// Error of the reported height and metres per pixel, uniform within +-, as a share (0.05 is 5 %).
    #[arg(long, default_value_t = 0.0)]
    scale_noise: f64,
    /// Standard deviation of the true pitch and roll, degrees.
    #[arg(long, default_value_t = 0.0)]
    attitude_noise_deg: f64,
    /// Report pitch and roll; else the columns stay empty.
    #[arg(long)]
    report_attitude: bool,
    /// Kind of flight.
    #[arg(long, value_enum, default_value_t = Trajectory::Random)]
    trajectory: Trajectory,
    /// Image up: `random` by default for random flights, else `track`.
    #[arg(long, value_enum)]
    heading: Option<Heading>,
    /// Height above ground, metres.
    #[arg(long, default_value_t = 580.0)]
    agl_m: f64,
    /// Ground speed of lawnmower and line flights, metres per second.
    #[arg(long, default_value_t = 20.0)]
    speed_mps: f64,
    /// Distance between the lanes of a lawnmower flight, metres.
    #[arg(long, default_value_t = 400.0)]
    lane_m: f64,
    /// Frame width, pixels.
    #[arg(long, default_value_t = 640)]
    width: usize,
    /// Frame height, pixels.
    #[arg(long, default_value_t = 512)]
    height: usize,
    /// Horizontal field of view, degrees.
    #[arg(long, default_value_t = 69.2)]
    hfov_deg: f64,
    /// Sensor noise: 0 none, 1 an uncooled camera.
    #[arg(long, default_value_t = 1.0)]
    noise: f64,
    /// Largest side of the rendered area, metres; of a larger map a part is drawn from the seed.
    #[arg(long, default_value_t = 4096.0)]
    area_m: f64,
}

/// Runs it.
pub fn run(_common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let source = match (args.map, args.world) {
        (Some(map), _) => MapSource::File { map, classes: args.classes },
        (None, Some(seed)) => MapSource::World(WorldOptions {
            seed,
            size_m: args.world_size_m,
            m_per_px: args.world_m_per_px,
            grain: args.world_grain.clamp(0.0, 50.0),
        }),
        (None, None) => return Err(UsageError("simulate: expected --map or --world, found neither".into())),
    };
    let by_default = if args.trajectory == Trajectory::Random { Heading::Random } else { Heading::Track };
    let options = SimulateOptions {
        source,
        out: args.out,
        frames: args.frames,
        seed: args.seed,
        radius_m: args.radius_m,
        prior_every: args.prior_every,
        yaw_noise_deg: args.yaw_noise_deg,
        scale_noise: args.scale_noise,
        attitude_noise_deg: args.attitude_noise_deg,
        report_attitude: args.report_attitude,
        trajectory: args.trajectory,
        heading: args.heading.unwrap_or(by_default),
        agl_m: args.agl_m,
        speed_mps: args.speed_mps,
        lane_m: args.lane_m,
        sensor: Sensor { width: args.width, height: args.height, hfov_deg: args.hfov_deg, noise: args.noise },
        area_m: args.area_m,
    };
    let bar = std::io::stderr().is_terminal().then(|| indicatif::ProgressBar::new(options.frames as u64));
    let report = simulate(&options, |done, _| {
        if let Some(bar) = &bar {
            bar.set_position(done as u64);
        }
    });
    if let Some(bar) = bar {
        bar.finish_and_clear();
    }
    let report = report.map_err(|e| UsageError::from_error(&e))?;
    let text = serde_json::to_string_pretty(&report).map_err(|e| UsageError::from_error(&e))?;
    writeln!(std::io::stdout(), "{text}").map_err(|e| UsageError::from_error(&e))?;
    Ok(Outcome::Done)
}
