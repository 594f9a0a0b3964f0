//! `nightfix frame --contact-sheet`: every frame of a flight, rectified, on one picture.

use crate::flight::Flight;
use crate::thermal::{self, FrameError, GrayFrame, Pose, Rectified};

/// Grey of what no sensor saw, and of the gaps between tiles.
const BACKGROUND: u8 = 32;
/// Pixels between tiles.
const GAP_PX: usize = 2;
/// Half the length of the cross at the point under the vehicle, pixels.
const CROSS_PX: i64 = 4;

/// A contact sheet and what could not be put on it.
pub struct Sheet {
    /// The picture: tiles in the flight's order, row by row, north up.
    pub picture: GrayFrame,
    /// Mean share of valid pixels of the tiles.
    pub valid_fraction: f64,
    /// Frames that are on it.
    pub frames: usize,
    /// File and reason of those that are not: their tiles stay empty.
    pub failed: Vec<(String, FrameError)>,
}

/// Decodes, tone-maps and rectifies every frame onto tiles of `tile_px` that show `width_m` of ground. An unknown yaw counts
/// as 0: the tile is then not north-up.
pub fn contact_sheet(flight: &Flight, width_m: f64, tile_px: usize) -> Sheet {
    let tile = |row| -> Result<Rectified, FrameError> {
        let (bytes, encoding) = flight.frame(row)?;
        let pose = flight.camera.camera_pose(&row.pose);
        let pose = Pose { yaw_deg: pose.yaw_deg.or(Some(0.0)), ..pose };
        let toned = thermal::tone_map(&thermal::decode(&bytes, encoding, None)?);
        thermal::rectify(&toned, &pose, tile_px, width_m / tile_px as f64)
    };
    // Somewhat wider than high.
    let columns = ((flight.rows.len() as f64 * 1.5).sqrt().ceil() as usize).max(1);
    let lines = flight.rows.len().div_ceil(columns).max(1);
    let pitch = tile_px + GAP_PX;
    let (width, height) = (columns * pitch + GAP_PX, lines * pitch + GAP_PX);
    let mut pixels = vec![BACKGROUND; width * height];
    let (mut failed, mut valid_fractions) = (Vec::new(), Vec::new());
    for (i, row) in flight.rows.iter().enumerate() {
        match tile(row) {
            Ok(square) => {
                let origin = ((i / columns) * pitch + GAP_PX) * width + (i % columns) * pitch + GAP_PX;
                paste(&square, &mut pixels, width, origin);
                valid_fractions.push(square.valid_fraction());
            }
            Err(error) => failed.push((row.file.clone(), error)),
        }
    }
    let frames = valid_fractions.len();
    let valid_fraction = valid_fractions.iter().sum::<f64>() / frames.max(1) as f64;
    Sheet { picture: GrayFrame { width: width as u32, height: height as u32, pixels }, valid_fraction, frames, failed }
}

fn paste(square: &Rectified, sheet: &mut [u8], sheet_width: usize, origin: usize) {
    let side = square.size_px;
    let (x, y) = (square.vehicle_px.0.round() as i64, square.vehicle_px.1.round() as i64);
    let lines = sheet.get_mut(origin..).unwrap_or_default().chunks_mut(sheet_width);
    let tiles = square.pixels.chunks_exact(side).zip(square.valid.chunks_exact(side));
    for (j, (line, (pixels, valid))) in (0_i64..).zip(lines.zip(tiles)) {
        for (i, (to, (&pixel, &seen))) in (0_i64..).zip(line.iter_mut().zip(pixels.iter().zip(valid))) {
            let on_cross = (i == x && (j - y).abs() <= CROSS_PX) || (j == y && (i - x).abs() <= CROSS_PX);
            *to = if on_cross {
                255
            } else if seen == 1 {
                pixel
            } else {
                BACKGROUND
            };
        }
    }
}
