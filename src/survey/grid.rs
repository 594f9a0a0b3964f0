//! Cells over a map, along its own pixels: so the result has the map's coordinate system, however it is turned.

use super::SurveyError;
use crate::geo::{Affine, Crs, Enu, LatLon};
use crate::map::{GeoTiff, WindowSpec};

/// Most cells.
const MAX_CELLS: usize = 1_000_000;

/// Cells row by row from the map's top left.
#[derive(Debug, Clone)]
pub struct Grid {
    /// Map pixel -> map coordinates.
    map_affine: Affine,
    map_size_px: (u32, u32),
    map_m_per_px: f64,
    pub crs: Crs,
    /// Side of a cell, map pixels.
    cell_px: usize,
    pub columns: usize,
    pub rows: usize,
}

impl PartialEq for Grid {
    fn eq(&self, other: &Self) -> bool {
        (self.map_affine, self.map_size_px, self.cell_px) == (other.map_affine, other.map_size_px, other.cell_px)
            && self.crs.epsg() == other.crs.epsg()
    }
}

impl Grid {
    pub fn over(map: &GeoTiff, cell_m: f64) -> Result<Self, SurveyError> {
        let cell_px = ((cell_m / map.m_per_px()).round() as usize).max(1);
        let (width, height) = map.size_px();
        let (columns, rows) = ((width as usize).div_ceil(cell_px), (height as usize).div_ceil(cell_px));
        if columns.saturating_mul(rows) > MAX_CELLS {
            let expected = format!("at most {MAX_CELLS} cells over the map");
            return Err(SurveyError::Option { option: "cell-m", expected, found: format!("{columns} x {rows}") });
        }
        Ok(Self {
            map_affine: *map.affine(),
            map_size_px: (width, height),
            map_m_per_px: map.m_per_px(),
            crs: map.crs().clone(),
            cell_px,
            columns,
            rows,
        })
    }

    pub fn cells(&self) -> usize {
        self.columns * self.rows
    }

    /// Column and row.
    pub fn place(&self, cell: usize) -> (usize, usize) {
        (cell % self.columns, cell / self.columns)
    }

    /// Cell pixel (integer = centre) -> map coordinates.
    pub fn affine(&self) -> Affine {
        let [a, b, _, d, e, _] = self.map_affine.0;
        let n = self.cell_px as f64;
        let (c, f) = self.map_affine.apply((n - 1.0) / 2.0, (n - 1.0) / 2.0);
        Affine([a * n, b * n, c, d * n, e * n, f])
    }

    /// Map coordinates -> cell.
    pub fn cell_at(&self, x: f64, y: f64) -> Option<usize> {
        let (column, row) = self.affine().inverse()?.apply(x, y);
        let (column, row) = (column.round(), row.round());
        let inside = column >= 0.0 && row >= 0.0 && column < self.columns as f64 && row < self.rows as f64;
        inside.then_some(row as usize * self.columns + column as usize)
    }

    /// A cell's middle.
    pub fn centre(&self, cell: usize) -> Result<LatLon, SurveyError> {
        self.within(cell, 0.5, 0.5)
    }

    /// The place at these shares of a cell's sides, from its top left; of a cell at the rim, of the part on the map.
    pub fn within(&self, cell: usize, across: f64, down: f64) -> Result<LatLon, SurveyError> {
        let (column, row) = self.place(cell);
        let at = |index: usize, share: f64, size_px: u32| {
            let from = (index * self.cell_px) as f64;
            let to = (from + self.cell_px as f64).min(f64::from(size_px));
            from + share * (to - from) - 0.5
        };
        let (x, y) = (at(column, across, self.map_size_px.0), at(row, down, self.map_size_px.1));
        let (x, y) = self.map_affine.apply(x, y);
        Ok(self.crs.inverse(x, y)?)
    }

    /// All cells, in squares of `side` cells.
    pub fn blocks(&self, side: usize) -> Vec<Vec<usize>> {
        let across = self.columns.div_ceil(side);
        let mut blocks = vec![Vec::new(); across * self.rows.div_ceil(side)];
        for cell in 0..self.cells() {
            let (column, row) = self.place(cell);
            if let Some(block) = blocks.get_mut(row / side * across + column / side) {
                block.push(cell);
            }
        }
        blocks
    }

    /// A window that holds these cells and `margin_m` round them.
    pub fn window(&self, cells: &[usize], margin_m: f64) -> Result<WindowSpec, SurveyError> {
        let Some(first) = cells.first() else {
            return Err(SurveyError::Option { option: "cell-m", expected: "cells".into(), found: "none".into() });
        };
        let origin = self.centre(*first)?;
        let (mut lo, mut hi) = (Enu::default(), Enu::default());
        for cell in cells {
            for (across, down) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
                let at = origin.enu_to(self.within(*cell, across, down)?);
                lo = Enu { east_m: lo.east_m.min(at.east_m), north_m: lo.north_m.min(at.north_m) };
                hi = Enu { east_m: hi.east_m.max(at.east_m), north_m: hi.north_m.max(at.north_m) };
            }
        }
        let middle = Enu { east_m: (lo.east_m + hi.east_m) / 2.0, north_m: (lo.north_m + hi.north_m) / 2.0 };
        let width_m = (hi.east_m - lo.east_m).max(hi.north_m - lo.north_m) + 2.0 * margin_m;
        Ok(WindowSpec { centre: origin.offset(middle), width_m, m_per_px: self.map_m_per_px.clamp(1.0, 10.0) })
    }
}
