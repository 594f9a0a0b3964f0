//! Frames of a block of cells: each frame of a cell is of another night.

use super::grid::Grid;
use super::{SurveyError, SurveyOptions, stream};
use crate::flight::ground::Ground;
use crate::flight::night;
use crate::flight::noise::Dice;
use crate::flight::sensor::{Faults, View, expose};
use crate::flight::trajectory::Waypoint;
use crate::geo::LatLon;
use crate::map::GeoTiff;
use std::collections::BTreeMap;
use std::path::Path;

/// Attempts to find a place in a cell where the whole frame lies on the map.
const ATTEMPTS: usize = 200;

/// A frame and its truth.
pub struct Shot {
    pub at: LatLon,
    pub yaw_deg: f64,
    pub counts: Vec<u16>,
}

/// Renders the frames of these cells of a block; of a cell where a frame lies nowhere whole on the map, none. The night is
/// that of the whole block, whichever cells are asked for: a survey that goes on sees what it would have seen.
pub fn block_shots(
    map_path: &Path,
    grid: &Grid,
    block: &[usize],
    cells: &[usize],
    options: &SurveyOptions,
) -> Result<BTreeMap<usize, Vec<Shot>>, SurveyError> {
    let sensor = options.sensor();
    let gsd_m = sensor.gsd_m(options.agl_m);
    let reach_m = 1.02 * gsd_m * (options.width as f64).hypot(options.height as f64) / 2.0;
    let window = grid.window(block, reach_m)?;
    let ground = Ground::read(GeoTiff::open(map_path)?, map_path, None, &window)?;
    let mut shots: BTreeMap<usize, Vec<Shot>> = BTreeMap::new();
    if !ground.scene.valid.contains(&1) {
        return Ok(shots);
    }
    for frame in 0..options.frames_per_cell {
        // The golden ratio's bits: nights of neighbouring seeds have nothing in common.
        let night_seed = options.seed.wrapping_add((frame as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let night = night::render(&ground.scene, night_seed);
        for cell in cells {
            let mut dice = Dice::new(options.seed, stream(*cell, frame));
            let Some((at, waypoint, view)) = place(grid, *cell, &ground, options, &mut dice)? else { continue };
            let mut faults = Faults::draw(&sensor, &mut dice);
            let drift_m = 0.4 * dice.normal();
            let (sin, cos) = waypoint.track_deg.to_radians().sin_cos();
            let axes = ground.local_axes(at);
            let counts = expose(&night, &sensor, &view, axes, [drift_m * sin, drift_m * cos], &mut faults, &mut dice);
            shots.entry(*cell).or_default().push(Shot { at, yaw_deg: view.yaw_deg, counts });
        }
    }
    Ok(shots)
}

/// A place in the cell, and how the camera looks there.
fn place(
    grid: &Grid,
    cell: usize,
    ground: &Ground,
    options: &SurveyOptions,
    dice: &mut Dice,
) -> Result<Option<(LatLon, Waypoint, View)>, SurveyError> {
    for _ in 0..ATTEMPTS {
        let at = grid.within(cell, dice.unit(), dice.unit())?;
        let [x, y] = ground.pixel(at);
        let waypoint = Waypoint { x, y, track_deg: dice.range(0.0, 360.0), along_m: 0.0 };
        let view = View { agl_m: options.agl_m, yaw_deg: dice.range(0.0, 360.0), pitch_deg: 0.0, roll_deg: 0.0 };
        if ground.holds(&waypoint, &view, &options.sensor()) {
            return Ok(Some((at, waypoint, view)));
        }
    }
    Ok(None)
}
