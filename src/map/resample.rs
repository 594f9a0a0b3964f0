//! The pixels of a window: bilinear from a block of the map, averaged first where the map is finer than the window.
//!
//! The rule: of the file's resolutions, the coarsest whose pixel is not coarser than the window's. Up to 1.34 map pixels per
//! window pixel one bilinear sample is taken; above, the mean of up to 3 x 3. From 4 on, boxes of k x k map pixels are averaged
//! first, k such that 2 to 3 boxes span a window pixel: a box as wide as the pixel would blur wherever the grids are out of
//! phase. Window pixels are made block by block, so that memory depends neither on the size of the map nor on that of its
//! pixels.

use super::block::Block;
use super::lattice::{Lattice, Point, mix};
use super::tiles::Tiles;
use super::{GeoTiff, MapError, Window, WindowSpec};

/// Window pixels made from one block of map, across and down; multiples of every lattice spacing.
const BLOCK_ACROSS: usize = 256;
const BLOCK_DOWN: usize = 128;
/// How much coarser than the window a resolution may be and still be used.
const LEVEL_TOLERANCE: f64 = 0.98;
/// Map pixels per window pixel from which two samples along an axis are averaged.
const TWO_SAMPLES_FROM: f64 = 1.34;
/// And three.
const THREE_SAMPLES_FROM: f64 = 2.4;

/// Which resolution is read, and how it is reduced on the way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reduction {
    pub level: usize,
    /// Map pixels averaged to one, along x and y.
    pub boxes: [usize; 2],
    /// Reduced pixels per full-resolution pixel, along x and y.
    scale: [f64; 2],
    /// Samples averaged along each axis of the window, 1 to 3.
    samples: usize,
}

impl Reduction {
    /// The choice for a window that takes `map_px_per_px` full-resolution pixels per pixel.
    pub fn choose(map: &GeoTiff, map_px_per_px: [f64; 2]) -> Self {
        let (level, shrink) = level_for(map, map_px_per_px);
        let steps = [map_px_per_px[0] * shrink[0], map_px_per_px[1] * shrink[1]];
        // `as` saturates and takes NaN to 0.
        let boxes = steps.map(|step| ((step / 2.0 + 0.05) as usize).clamp(1, 4096));
        let left = (steps[0] / boxes[0] as f64).max(steps[1] / boxes[1] as f64);
        Self {
            level,
            boxes,
            scale: [shrink[0] / boxes[0] as f64, shrink[1] / boxes[1] as f64],
            samples: 1 + usize::from(left > TWO_SAMPLES_FROM) + usize::from(left > THREE_SAMPLES_FROM),
        }
    }

    /// Full-resolution pixel -> reduced pixel, integers being centres of both.
    fn apply(&self, at: Point) -> Point {
        [(at[0] + 0.5) * self.scale[0] - 0.5, (at[1] + 0.5) * self.scale[1] - 0.5]
    }
}

/// The coarsest resolution whose pixel is not coarser than `map_px_per_px` full-resolution pixels along either axis (the full
/// image, if none), and its pixels per full-resolution pixel.
pub(super) fn level_for(map: &GeoTiff, map_px_per_px: [f64; 2]) -> (usize, [f64; 2]) {
    let (full_width, full_height) = map.size_px();
    let mut chosen = (0, [1.0, 1.0]);
    for (i, level) in map.levels().iter().enumerate() {
        let scale = [f64::from(level.width) / f64::from(full_width), f64::from(level.height) / f64::from(full_height)];
        if map_px_per_px[0] * scale[0] >= LEVEL_TOLERANCE && map_px_per_px[1] * scale[1] >= LEVEL_TOLERANCE {
            chosen = (i, scale);
        }
    }
    chosen
}

/// Makes a window.
pub(super) fn render(map: &GeoTiff, tiles: &mut Tiles, spec: &WindowSpec) -> Result<Window, MapError> {
    let size = spec.size_px()?;
    let lattice = Lattice::new(map, spec, size);
    let reduction = Reduction::choose(map, lattice.map_px_per_px);
    let mut window = Window {
        spec: *spec,
        size_px: size,
        rgb: vec![0; size * size * 3],
        valid: vec![0; size * size],
        map_affine: lattice.map_affine,
    };
    let mut block = Block::default();
    for top in (0..size).step_by(BLOCK_DOWN) {
        for left in (0..size).step_by(BLOCK_ACROSS) {
            let area = Area { left, top, right: (left + BLOCK_ACROSS).min(size), bottom: (top + BLOCK_DOWN).min(size) };
            if area.fill(map, tiles, &lattice, &reduction, &mut block)? {
                area.sample(&lattice, &reduction, &block, &mut window);
            }
        }
    }
    Ok(window)
}

/// A rectangle of window pixels.
#[derive(Clone, Copy)]
struct Area {
    left: usize,
    top: usize,
    right: usize,
    bottom: usize,
}

impl Area {
    /// Loads the map under this area into `block`; `false` where there is none.
    fn fill(
        self,
        map: &GeoTiff,
        tiles: &mut Tiles,
        lattice: &Lattice,
        reduction: &Reduction,
        block: &mut Block,
    ) -> Result<bool, MapError> {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        // Bilinear cells take their extremes at their nodes.
        for row in self.top / lattice.spacing..=self.bottom.div_ceil(lattice.spacing) {
            for column in self.left / lattice.spacing..=self.right.div_ceil(lattice.spacing) {
                let at = reduction.apply(lattice.node(column, row));
                for axis in 0..2 {
                    // NaN leaves both as they are.
                    low[axis] = low[axis].min(at[axis]);
                    high[axis] = high[axis].max(at[axis]);
                }
            }
        }
        // One pixel for the neighbour, the others for samples beside the pixel's centre.
        block.load(map, tiles, reduction, [low[0] - 3.0, low[1] - 3.0], [high[0] + 3.0, high[1] + 3.0], self.pixels())
    }

    fn pixels(self) -> usize {
        (self.right - self.left) * (self.bottom - self.top)
    }

    /// Samples every pixel of this area from `block`.
    fn sample(self, lattice: &Lattice, reduction: &Reduction, block: &Block, window: &mut Window) {
        let spacing = lattice.spacing;
        for y in self.top..self.bottom {
            let row = y / spacing;
            let v = (y % spacing) as f64 / spacing as f64;
            for column in self.left / spacing..self.right.div_ceil(spacing) {
                let (start, end) = ((column * spacing).max(self.left), ((column + 1) * spacing).min(self.right));
                let along = |column: usize| {
                    mix(reduction.apply(lattice.node(column, row)), reduction.apply(lattice.node(column, row + 1)), v)
                };
                let (from, to) = (along(column), along(column + 1));
                let step = [(to[0] - from[0]) / spacing as f64, (to[1] - from[1]) / spacing as f64];
                if from.iter().chain(&to).any(|v| !v.is_finite()) {
                    continue;
                }
                let pixels = y * window.size_px + start..y * window.size_px + end;
                let (Some(rgb), Some(valid)) =
                    (window.rgb.get_mut(pixels.start * 3..pixels.end * 3), window.valid.get_mut(pixels))
                else {
                    continue;
                };
                if reduction.samples == 1 {
                    block.row(from, step, rgb, valid);
                } else {
                    let below = |column: usize| {
                        let [top, bottom] = [row, row + 1].map(|row| reduction.apply(lattice.node(column, row)));
                        [(bottom[0] - top[0]) / spacing as f64, (bottom[1] - top[1]) / spacing as f64]
                    };
                    block.row_averaged(from, step, below(column), reduction.samples, rgb, valid);
                }
            }
        }
    }
}
