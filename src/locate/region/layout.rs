//! How tiles, blocks and frames fit together.
//!
//! In a tile's image, shift d lays the frame's middle on pixel `(n_px - 1) / 2 + rim + stride d`, n_px the side of the
//! frame's input: as `stages::Geometry` has it, with the rim as margin.

use super::super::hypotheses::Hypothesis;
use super::super::stages::Similarity;
use super::super::{NoFix, Reason};
use crate::geo::{Enu, LatLon};
use crate::map::{Window, WindowSpec};
use crate::model::CorrelationStage;

/// Map encoded beyond the block on each side, pixels: the receptive field of the light encoder reaches 90. Whether it is
/// enough for a bundle is tried (`features_belong_to_the_map`).
pub const RIM_PX: usize = 96;
/// Tiles are multiples of this apart, pixels: the coarsest stride inside an encoder.
pub const ALIGN_PX: usize = 16;
/// More tiles than any region that fits a configuration at a scale in use.
const MAX_TILES: i64 = 4096;

/// How tiles, blocks and frames fit together, of a bundle at a scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    /// Cells along a block's side: N.
    pub block: usize,
    /// Shifts along a side that a tile owns.
    pub shifts: usize,
    /// Cells along the frame's side.
    pub cells: usize,
    /// Pixels per cell.
    pub stride: usize,
    /// Side of the frame's input, pixels.
    pub frame_px: usize,
    /// Ground metres per input pixel.
    pub m_per_px: f64,
}

impl Layout {
    /// Of this stage with blocks of at least `block` cells; `None` where its stride does not fit.
    pub fn new(stage: &CorrelationStage, block: usize, scale: f64) -> Option<Self> {
        let (stride, frame_px) = (stage.stride as usize, stage.frame.size_px as usize);
        if stride == 0 || ALIGN_PX % stride != 0 {
            return None;
        }
        let (cells, unit) = (frame_px / stride, ALIGN_PX / stride);
        let block = block.max(2 * cells).next_multiple_of(unit);
        let shifts = (block - cells) / unit * unit;
        Some(Self { block, shifts, cells, stride, frame_px, m_per_px: stage.map.m_per_px() * scale })
    }

    /// Side of a tile's image, pixels.
    pub fn tile_px(&self) -> usize {
        self.stride * self.block + 2 * RIM_PX
    }

    /// Metres from tile to tile.
    pub fn step_m(&self) -> f64 {
        (self.stride * self.shifts) as f64 * self.m_per_px
    }

    /// Metres from shift to shift.
    pub fn cell_m(&self) -> f64 {
        self.stride as f64 * self.m_per_px
    }

    /// The frame's middle at shift `d`, pixels of the tile's image.
    pub fn middle_px(&self, d: f64) -> f64 {
        (self.frame_px as f64 - 1.0) / 2.0 + RIM_PX as f64 + self.stride as f64 * d
    }

    /// The frame's middle at shift 0, metres from the tile's middle (east and south).
    fn first_m(&self) -> f64 {
        (self.frame_px as f64 - (self.stride * self.block) as f64) / 2.0 * self.m_per_px
    }

    /// Columns or rows of tiles that own middles from `low` to `high` metres (east or south of the map's middle).
    fn span(&self, low: f64, high: f64) -> std::ops::RangeInclusive<i64> {
        let at = |m: f64| ((m - self.first_m()) / self.step_m()).floor().clamp(-1e9, 1e9) as i64;
        at(low)..=at(high)
    }

    /// A tile's image.
    pub fn spec(&self, map_centre: LatLon, at: [i64; 2]) -> WindowSpec {
        let [east, south] = at.map(|i| i as f64 * self.step_m());
        let centre = map_centre.offset(Enu { east_m: east, north_m: -south });
        WindowSpec { centre, width_m: self.tile_px() as f64 * self.m_per_px, m_per_px: self.m_per_px }
    }

    /// Shifts under which at least `share` of the frame's north-up square lies on valid map.
    pub fn allowed(&self, window: &Window, share: f64) -> Vec<bool> {
        let side = window.size_px;
        let mut sums = vec![0u32; (side + 1) * (side + 1)];
        for (y, row) in window.valid.chunks_exact(side).enumerate() {
            let mut run = 0;
            for (x, valid) in row.iter().enumerate() {
                run += u32::from(*valid != 0);
                let above = sums.get(y * (side + 1) + x + 1).copied().unwrap_or(0);
                if let Some(sum) = sums.get_mut((y + 1) * (side + 1) + x + 1) {
                    *sum = above + run;
                }
            }
        }
        let at = |x: usize, y: usize| sums.get(y * (side + 1) + x).copied().unwrap_or(0);
        let (n, wanted) = (self.frame_px, share * (self.frame_px * self.frame_px) as f64);
        let place = |i: usize| {
            let (x, y) = (RIM_PX + self.stride * (i % self.shifts), RIM_PX + self.stride * (i / self.shifts));
            let seen = at(x + n, y + n) + at(x, y) - at(x + n, y) - at(x, y + n);
            seen > 0 && f64::from(seen) >= wanted
        };
        (0..self.shifts * self.shifts).map(place).collect()
    }
}

/// Where a region is searched.
#[derive(Debug, Clone, Copy)]
pub struct Disc {
    /// Middle of the disc of the vehicle.
    pub centre: LatLon,
    /// Its radius, metres.
    pub radius_m: f64,
    /// The vehicle's place against the frame's middle, metres east and south in the frame as assumed.
    pub vehicle_m: [f64; 2],
}

/// Tiles that own a place in the disc, nearest to its middle first.
pub fn tiles_of(layout: &Layout, map_centre: LatLon, disc: &Disc) -> Result<Vec<[i64; 2]>, NoFix> {
    let at = map_centre.enu_to(disc.centre);
    // The vehicle may be off the frame's middle, whichever way the frame is turned; one cell for rounding.
    let reach_m = disc.radius_m + disc.vehicle_m[0].hypot(disc.vehicle_m[1]) * 1.5 + layout.cell_m();
    let columns = layout.span(at.east_m - reach_m, at.east_m + reach_m);
    let rows = layout.span(-at.north_m - reach_m, -at.north_m + reach_m);
    let count = |span: &std::ops::RangeInclusive<i64>| span.end() - span.start() + 1;
    let tiles = count(&columns).saturating_mul(count(&rows));
    if !(1..=MAX_TILES).contains(&tiles) {
        let detail = format!("region: expected at most {MAX_TILES} tiles of {:.0} m, found {tiles}", layout.step_m());
        return Err(NoFix::new(Reason::PriorTooWide, detail));
    }
    let mut found: Vec<[i64; 2]> = rows.flat_map(|row| columns.clone().map(move |column| [column, row])).collect();
    let middle_m = layout.first_m() + layout.step_m() / 2.0;
    let distance_m = |tile: &[i64; 2]| {
        let [east, south] = tile.map(|i| i as f64 * layout.step_m() + middle_m);
        (east - at.east_m).hypot(south + at.north_m)
    };
    let diagonal_m = layout.step_m() * std::f64::consts::FRAC_1_SQRT_2;
    found.retain(|tile| distance_m(tile) <= reach_m + diagonal_m);
    found.sort_by(|a, b| distance_m(a).total_cmp(&distance_m(b)).then(a.cmp(b)));
    Ok(found)
}

/// Whether shift number `i` of a tile is a place in the disc under a hypothesis: the disc is about the vehicle.
pub fn inside(layout: &Layout, spec: &WindowSpec, disc: &Disc, hypothesis: &Hypothesis) -> impl Fn(usize) -> bool + use<> {
    let off = spec.centre.enu_to(disc.centre);
    let vehicle = turned(disc.vehicle_m, hypothesis);
    let middle = (layout.tile_px() as f64 - 1.0) / 2.0;
    let [x, y] = [off.east_m - vehicle[0], -off.north_m - vehicle[1]].map(|m| middle + m / layout.m_per_px);
    let (layout, reach) = (*layout, disc.radius_m / layout.m_per_px);
    move |i| {
        let (dx, dy) = ((i % layout.shifts) as f64, (i / layout.shifts) as f64);
        (layout.middle_px(dx) - x).hypot(layout.middle_px(dy) - y) <= reach
    }
}

/// An offset in the frame as assumed, on the ground under a hypothesis (east and south).
pub fn turned(offset_m: [f64; 2], hypothesis: &Hypothesis) -> [f64; 2] {
    let Hypothesis { rotation_deg, scale } = *hypothesis;
    Similarity { centre_px: [0.0; 2], rotation_deg, scale }.apply(offset_m[0], offset_m[1])
}
