//! Before the flight: where on this map will fixes work?
//!
//! In the order of the work: [`grid`] lays cells over the map; [`render`] makes frames of each cell, as the simulator does, a
//! night for each; the [`Localizer`] answers them with priors and errors as drawn; [`journal`] keeps a row for each cell that
//! is done, so that a survey that was stopped goes on; [`output`] writes GeoTIFF, table and picture.

mod grid;
mod journal;
mod output;
mod render;

use crate::flight::SimulateError;
use crate::flight::noise::Dice;
use crate::flight::sensor::Sensor;
use crate::geo::Enu;
use crate::locate::{EncodedFrame, Evidence, Localizer, Prior, PriorSource, Query};
use crate::map::{GeoTiff, MapError};
use crate::thermal::{Encoding, Pose};
use grid::Grid;
use journal::Journal;
pub use journal::{CellRow, Header, SCHEMA};
pub use output::{Summary, write_outputs};
use render::{Shot, block_shots};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Side of what is rendered at once, metres: whole cells, at least one.
const BLOCK_M: f64 = 1280.0;

/// What to survey.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SurveyOptions {
    /// Side of a cell, metres (rounded to whole map pixels).
    pub cell_m: f64,
    /// Frames for each cell, each of another night.
    pub frames_per_cell: usize,
    /// Seed of nights, places, errors, noise.
    pub seed: u64,
    /// Priors lie uniformly in a disc of this radius about the truth, metres.
    pub radius_m: f64,
    /// Reported yaw is off by up to this, uniform, degrees.
    pub yaw_noise_deg: f64,
    /// Reported height and metres per pixel are off by up to this share, uniform.
    pub scale_noise: f64,
    /// Height above ground, metres.
    pub agl_m: f64,
    /// Frame width, pixels.
    pub width: usize,
    /// Frame height, pixels.
    pub height: usize,
    /// Horizontal field of view, degrees.
    pub hfov_deg: f64,
}

impl SurveyOptions {
    fn sensor(&self) -> Sensor {
        Sensor { width: self.width, height: self.height, hfov_deg: self.hfov_deg, noise: 1.0 }
    }

    fn check(&self) -> Result<(), SurveyError> {
        let numbers = [
            ("cell-m", self.cell_m, 32.0, 4096.0),
            ("radius-m", self.radius_m, 1.0, 100_000.0),
            ("yaw-noise-deg", self.yaw_noise_deg, 0.0, 180.0),
            ("scale-noise", self.scale_noise, 0.0, 0.5),
            ("agl-m", self.agl_m, 10.0, 20_000.0),
            ("hfov-deg", self.hfov_deg, 1.0, 150.0),
            ("frames-per-cell", self.frames_per_cell as f64, 1.0, 1000.0),
            ("width", self.width as f64, 16.0, 4096.0),
            ("height", self.height as f64, 16.0, 4096.0),
        ];
        for (option, found, least, most) in numbers {
            if !(least..=most).contains(&found) {
                return Err(SurveyError::Option { option, expected: format!("{least} to {most}"), found: found.to_string() });
            }
        }
        Ok(())
    }
}

/// What can go wrong.
#[derive(Debug, thiserror::Error)]
pub enum SurveyError {
    /// An option is out of range.
    #[error("survey: --{option}: expected {expected}, found {found}")]
    Option {
        /// Which.
        option: &'static str,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A file could not be read or written.
    #[error("survey: `{path}`: {why}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        why: String,
    },
    /// The folder holds another survey.
    #[error("survey: `{path}` is of another survey: {field}: expected {expected}, found {found}; take another --out")]
    Other {
        /// The journal.
        path: PathBuf,
        /// What differs.
        field: String,
        /// As asked for now.
        expected: String,
        /// As begun.
        found: String,
    },
    /// The map cannot be read or the GeoTIFF not be written.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The map's place cannot be transformed.
    #[error(transparent)]
    Geo(#[from] crate::geo::GeoError),
    /// A part of the map cannot be rendered.
    #[error(transparent)]
    Render(#[from] SimulateError),
}

impl SurveyError {
    fn file(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |error| Self::File { path, why: error.to_string() }
    }
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Survey {
    /// Cells over the map.
    grid: Grid,
    /// A row for each cell, row by row from the top left.
    pub rows: Vec<CellRow>,
}

/// Surveys a map, or goes on where an earlier run stopped. `header` names what the answers depend on beside the options.
/// `progress(done, total)` counts cells.
pub fn survey(
    map_path: &Path,
    localizer: &mut Localizer,
    header: &Header,
    folder: &Path,
    mut progress: impl FnMut(usize, usize),
) -> Result<Survey, SurveyError> {
    let options = &header.options;
    options.check()?;
    let map = GeoTiff::open(map_path)?;
    let grid = Grid::over(&map, options.cell_m)?;
    std::fs::create_dir_all(folder).map_err(SurveyError::file(folder))?;
    let mut journal = Journal::open(folder, header, grid.cells())?;
    progress(journal.done(), grid.cells());
    let block_cells = ((BLOCK_M / options.cell_m).floor() as usize).max(1);
    for block in grid.blocks(block_cells) {
        let open: Vec<usize> = block.iter().copied().filter(|cell| !journal.has(*cell)).collect();
        if open.is_empty() {
            continue;
        }
        let shots = block_shots(map_path, &grid, &block, &open, options)?;
        for cell in open {
            let row = judge_cell(&grid, cell, shots.get(&cell).map_or(&[], Vec::as_slice), localizer, options)?;
            journal.add(row)?;
            progress(journal.done(), grid.cells());
        }
    }
    Ok(Survey { grid, rows: journal.into_rows() })
}

/// Locates the frames of a cell.
fn judge_cell(
    grid: &Grid,
    cell: usize,
    shots: &[Shot],
    localizer: &mut Localizer,
    options: &SurveyOptions,
) -> Result<CellRow, SurveyError> {
    let (mut errors_m, mut radii_m, mut beyond, mut no_fix) = (Vec::new(), Vec::new(), 0, BTreeMap::new());
    let sensor = options.sensor();
    for (i, shot) in shots.iter().enumerate() {
        let mut dice = Dice::new(options.seed, stream(cell, i) + 1);
        let error = 1.0 + options.scale_noise * dice.range(-1.0, 1.0);
        let yaw_deg = (shot.yaw_deg + options.yaw_noise_deg * dice.range(-1.0, 1.0)).rem_euclid(360.0);
        let (radius_m, angle) = (options.radius_m * dice.unit().sqrt(), dice.range(0.0, std::f64::consts::TAU));
        let position = shot.at.offset(Enu { east_m: radius_m * angle.sin(), north_m: radius_m * angle.cos() });
        let prior = Prior {
            position,
            radius_m: options.radius_m,
            sigma_m: None,
            source: PriorSource::External,
            chain: 0,
            age_s: Some(0.0),
        };
        let pose = Pose {
            agl_m: Some(options.agl_m * error),
            gsd_m: Some(sensor.gsd_m(options.agl_m) * error),
            hfov_deg: Some(options.hfov_deg),
            yaw_deg: Some(yaw_deg),
            pitch_deg: Some(0.0),
            roll_deg: Some(0.0),
        };
        let bytes: Vec<u8> = shot.counts.iter().flat_map(|count| count.to_le_bytes()).collect();
        let size_px = Some((options.width as u32, options.height as u32));
        let frame = Ok(EncodedFrame { bytes: &bytes, encoding: Encoding::Y16le, size_px });
        let answer = localizer.locate(&Query { stamp_ns: 0, frame, pose, prior: Ok(prior) });
        match answer.outcome {
            Ok(fix) => {
                let inputs = input_error(&answer.evidence, &mut dice);
                let error_m = fix.position.offset(inputs).distance_m(shot.at);
                errors_m.push(error_m);
                radii_m.push(fix.radius95_m);
                beyond += usize::from(!(error_m <= fix.radius999_m));
            }
            Err(why) => *no_fix.entry(why.reason).or_insert(0) += 1,
        }
    }
    let over_50m = errors_m.iter().filter(|error_m| !(**error_m <= 50.0)).count();
    let centre = grid.centre(cell)?;
    Ok(CellRow {
        cell,
        lat_deg: centre.lat_deg,
        lon_deg: centre.lon_deg,
        frames: shots.len(),
        fixes: errors_m.len(),
        median_error_m: median(&mut errors_m),
        median_radius95_m: median(&mut radii_m),
        over_50m,
        beyond_radius999: beyond,
        no_fix,
    })
}

/// What attitude, map and time stamps are wrong by in flight, as the error budget states them: here they are exact.
fn input_error(evidence: &Evidence, dice: &mut Dice) -> Enu {
    let sigma = |name: &str| evidence.get(name).copied().unwrap_or(0.0);
    let sigma_m = sigma("sigma_tilt_m").hypot(sigma("sigma_map_m")).hypot(sigma("sigma_stamp_m"));
    Enu { east_m: sigma_m * dice.normal(), north_m: sigma_m * dice.normal() }
}

/// Random numbers of a frame of a cell, whatever was surveyed before it: this stream and the next.
fn stream(cell: usize, frame: usize) -> u64 {
    (1 << 32) + 4096 * cell as u64 + 2 * frame as u64
}

/// The middle one, or the mean of the two.
fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let (low, high) = (values.get(values.len().checked_sub(1)? / 2)?, values.get(values.len() / 2)?);
    Some(0.5 * (low + high))
}
