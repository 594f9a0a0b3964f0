//! Where the map is valid, coarsely: a grid of probes about a point and its integral image.

use super::decode::chunk_origin;
use super::lattice::Lattice;
use super::tiles::Tiles;
use super::{GeoTiff, MapError, WindowSpec};
use crate::geo::LatLon;

/// Probes along a footprint's side.
const PROBES_PER_FOOTPRINT: f64 = 64.0;
/// Probes along the grid's side: beyond, they stand further apart.
const MAX_PROBES: f64 = 2048.0;

/// Whether a north-up square of `footprint_m` whose middle is within `radius_m` of `centre` lies at least `share` on valid map.
pub(super) fn can_hold(
    map: &GeoTiff,
    tiles: &mut Tiles,
    centre: LatLon,
    radius_m: f64,
    footprint_m: f64,
    share: f64,
) -> Result<bool, MapError> {
    // Nearly always the middle itself will do.
    if radius_m > 0.0 && can_hold(map, tiles, centre, 0.0, footprint_m, share)? {
        return Ok(true);
    }
    let width_m = 2.0 * radius_m.max(0.0) + footprint_m;
    let step_m = (footprint_m / PROBES_PER_FOOTPRINT).max(width_m / MAX_PROBES);
    let spec = WindowSpec { centre, width_m, m_per_px: step_m };
    let size = spec.size_px()?;
    let valid = Grid::probe(map, tiles, &spec, size)?;
    let side = ((footprint_m / step_m).round() as usize).clamp(1, size);
    // Probes stand symmetrically about the centre; a square of `side` probes from (i, j) has its middle at i + (side - 1) / 2.
    let middle = (size - side) as f64 / 2.0;
    let reach = radius_m.max(0.0) / step_m + 0.5;
    let wanted = share * (side * side) as f64;
    for j in 0..=size - side {
        for i in 0..=size - side {
            let within = (i as f64 - middle).hypot(j as f64 - middle) <= reach;
            if within && f64::from(valid.count(i, j, side)) >= wanted {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

/// Numbers of valid probes above and left of every corner.
struct Grid {
    stride: usize,
    sums: Vec<u32>,
}

impl Grid {
    fn probe(map: &GeoTiff, tiles: &mut Tiles, spec: &WindowSpec, size: usize) -> Result<Self, MapError> {
        let lattice = Lattice::new(map, spec, size);
        let mut probes = Probes::new(map, lattice.map_px_per_px);
        let stride = size + 1;
        let mut sums = vec![0_u32; stride * stride];
        for y in 0..size {
            let mut row = 0;
            for x in 0..size {
                row += u32::from(probes.is_valid(map, tiles, lattice.map_px(x as f64, y as f64))?);
                let above = sums.get(y * stride + x + 1).copied().unwrap_or(0);
                if let Some(sum) = sums.get_mut((y + 1) * stride + x + 1) {
                    *sum = above + row;
                }
            }
        }
        Ok(Self { stride, sums })
    }

    /// Valid probes in a square of `side` from (x, y).
    fn count(&self, x: usize, y: usize, side: usize) -> u32 {
        let at = |x: usize, y: usize| self.sums.get(y * self.stride + x).copied().unwrap_or(0);
        at(x + side, y + side) + at(x, y) - at(x + side, y) - at(x, y + side)
    }
}

/// Answers for single points; decodes only where the map has pixels that can be invalid.
struct Probes {
    level: usize,
    scale: [f64; 2],
    last: Option<(u32, bool, Option<std::sync::Arc<super::decode::Tile>>)>,
}

impl Probes {
    /// Probes the coarsest resolution whose pixel is not coarser than the distance between probes.
    fn new(map: &GeoTiff, map_px_per_probe: [f64; 2]) -> Self {
        let (level, scale) = super::resample::level_for(map, map_px_per_probe);
        Self { level, scale, last: None }
    }

    fn is_valid(&mut self, map: &GeoTiff, tiles: &mut Tiles, at: [f64; 2]) -> Result<bool, MapError> {
        let Some(level) = map.levels().get(self.level) else { return Ok(false) };
        let [x, y] = [0, 1].map(|axis| (at[axis] + 0.5) * self.scale[axis]);
        // NaN fails both.
        if !((0.0..f64::from(level.width)).contains(&x) && (0.0..f64::from(level.height)).contains(&y)) {
            return Ok(false);
        }
        let (x, y) = (x as usize, y as usize);
        let chunk = (y / level.chunk_height as usize * level.across() as usize + x / level.chunk_width as usize) as u32;
        if self.last.as_ref().is_none_or(|(known, ..)| *known != chunk) {
            let written = !level.is_sparse(chunk);
            let tile = if written && map.has_pixel_validity() { tiles.get(map, self.level, chunk)? } else { None };
            self.last = Some((chunk, written, tile));
        }
        Ok(match &self.last {
            Some((_, true, Some(tile))) => {
                let (left, top) = chunk_origin(level, chunk);
                tile.pixels.get((y - top) * tile.width + x - left).is_some_and(|p| p >> 24 == 255)
            }
            Some((_, written, _)) => *written,
            None => false,
        })
    }
}
