//! From window pixels to map pixels: exact at the nodes of a lattice, bilinear between them.
//!
//! A node goes the whole way: ENU offset -> geodesic -> projection -> inverse affine. Between nodes the mapping bends by less
//! than `TOLERANCE_PX`, which is checked where it bends most; where it does not hold the lattice is made finer.

use super::geotiff::GeoTiff;
use super::window::WindowSpec;

/// Node spacings tried, window pixels.
const SPACINGS: [usize; 5] = [128, 64, 32, 16, 8];
/// Largest error between nodes, window pixels.
const TOLERANCE_PX: f64 = 0.005;

/// A point in map pixels (full resolution, integer = centre); NaN where the projection has no image.
pub(super) type Point = [f64; 2];

/// Nodes every `spacing` window pixels, from pixel 0 past the last one.
pub(super) struct Lattice {
    pub spacing: usize,
    across: usize,
    nodes: Vec<Point>,
    /// Full-resolution map pixels, along the map's x and y, that one window pixel spans at the middle.
    pub map_px_per_px: [f64; 2],
    /// Window pixel -> map CRS coordinates, least squares over the corners and the middle.
    pub map_affine: [f64; 6],
}

impl Lattice {
    /// The lattice for a window of `size_px`.
    pub fn new(map: &GeoTiff, spec: &WindowSpec, size_px: usize) -> Self {
        let exact = Mapping::new(map, spec, size_px);
        let middle = (size_px as f64 - 1.0) / 2.0;
        let [left, right] = [-0.5, 0.5].map(|d| exact.map_px(middle + d, middle));
        let [top, bottom] = [-0.5, 0.5].map(|d| exact.map_px(middle, middle + d));
        let span = |axis: usize| (right[axis] - left[axis]).hypot(bottom[axis] - top[axis]);
        let mut this =
            Self { spacing: 0, across: 0, nodes: Vec::new(), map_px_per_px: [span(0), span(1)], map_affine: exact.best_affine() };
        let tolerance = TOLERANCE_PX * this.map_px_per_px[0].max(this.map_px_per_px[1]);
        for spacing in SPACINGS {
            this.fill(&exact, spacing, size_px);
            if this.bend(&exact) <= tolerance {
                break;
            }
        }
        this
    }

    fn fill(&mut self, exact: &Mapping, spacing: usize, size_px: usize) {
        self.spacing = spacing;
        self.across = (size_px - 1) / spacing + 2;
        let at = |i: usize| (i * spacing) as f64;
        self.nodes = (0..self.across * self.across).map(|i| exact.map_px(at(i % self.across), at(i / self.across))).collect();
    }

    /// The largest error in the middles of five cells, map pixels; nodes without an image do not count.
    fn bend(&self, exact: &Mapping) -> f64 {
        let last = self.across - 2;
        let error = |(column, row): (usize, usize)| {
            let [x, y] = [column, row].map(|i| (i as f64 + 0.5) * self.spacing as f64);
            let corners = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| self.node(column + dx, row + dy));
            let mean = |axis: usize| corners.iter().map(|c| c[axis]).sum::<f64>() / 4.0;
            let at = exact.map_px(x, y);
            (mean(0) - at[0]).hypot(mean(1) - at[1])
        };
        let cells = [(0, 0), (last, 0), (0, last), (last, last), (last / 2, last / 2)];
        cells.into_iter().map(error).filter(|e| e.is_finite()).fold(0.0, f64::max)
    }

    /// Where a node lies on the map.
    pub fn node(&self, column: usize, row: usize) -> Point {
        self.nodes.get(row * self.across + column).copied().unwrap_or([f64::NAN; 2])
    }

    /// Where a window pixel lies on the map.
    pub fn map_px(&self, x: f64, y: f64) -> Point {
        let cell = |v: f64| ((v / self.spacing as f64) as usize).min(self.across - 2);
        let (column, row) = (cell(x), cell(y));
        let [u, v] = [x / self.spacing as f64 - column as f64, y / self.spacing as f64 - row as f64];
        let along = |row: usize| mix(self.node(column, row), self.node(column + 1, row), u);
        mix(along(row), along(row + 1), v)
    }
}

/// `a + (b - a) t`.
pub(super) fn mix(a: Point, b: Point, t: f64) -> Point {
    [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t]
}

/// The exact mapping.
struct Mapping<'a> {
    map: &'a GeoTiff,
    spec: &'a WindowSpec,
    size_px: usize,
    from_crs: Option<crate::geo::Affine>,
    /// First coordinate of the map's middle: of equivalent longitudes the one nearest to it is meant.
    near_x: f64,
}

impl<'a> Mapping<'a> {
    fn new(map: &'a GeoTiff, spec: &'a WindowSpec, size_px: usize) -> Self {
        let (width, height) = map.size_px();
        let near_x = map.affine().apply(f64::from(width) / 2.0, f64::from(height) / 2.0).0;
        // A centre outside the projection's area (another continent's UTM zone) has no place on this map.
        let from_crs = map.crs().forward_checked(spec.centre).ok().and_then(|_| map.affine().inverse());
        Self { map, spec, size_px, from_crs, near_x }
    }

    /// Window pixel -> CRS coordinates.
    fn crs_point(&self, x: f64, y: f64) -> Point {
        let at = self.spec.to_lat_lon(self.size_px, x, y);
        let Ok((cx, cy)) = self.map.crs().forward(at) else { return [f64::NAN; 2] };
        let turns = self.map.crs().wrap().map_or(0.0, |turn| ((self.near_x - cx) / turn).round() * turn);
        [cx + turns, cy]
    }

    /// Window pixel -> map pixel.
    fn map_px(&self, x: f64, y: f64) -> Point {
        let Some(from_crs) = &self.from_crs else { return [f64::NAN; 2] };
        let [cx, cy] = self.crs_point(x, y);
        from_crs.apply(cx, cy).into()
    }

    fn best_affine(&self) -> [f64; 6] {
        if self.from_crs.is_none() {
            return [f64::NAN; 6];
        }
        let middle = (self.size_px as f64 - 1.0) / 2.0;
        let arm = middle.max(0.5);
        let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)];
        let points = corners.map(|(sx, sy)| self.crs_point(middle + sx * arm, middle + sy * arm));
        let centre = self.crs_point(middle, middle);
        // The five abscissae are symmetric about the middle, so that slopes and offset are independent.
        let fit = |axis: usize| {
            let slope = |sign: fn((f64, f64)) -> f64| {
                corners.iter().zip(&points).map(|(&c, p)| sign(c) * p[axis]).sum::<f64>() / (4.0 * arm)
            };
            let (a, b) = (slope(|c| c.0), slope(|c| c.1));
            let mean = (points.iter().map(|p| p[axis]).sum::<f64>() + centre[axis]) / 5.0;
            [a, b, mean - (a + b) * middle]
        };
        let ([a, b, c], [d, e, f]) = (fit(0), fit(1));
        [a, b, c, d, e, f]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geo::{Affine, Crs, Enu};
    use crate::map::write_rgb;

    /// A map of one grey pixel's worth of content, somewhere.
    fn map(code: u32, affine: [f64; 6]) -> (tempfile::TempDir, GeoTiff) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.tif");
        write_rgb(&path, &[7; 3 * 32 * 32], 32, 32, &Affine(affine), &Crs::from_epsg(code).unwrap()).unwrap();
        let map = GeoTiff::open(&path).unwrap();
        (dir, map)
    }

    #[test]
    fn between_nodes_the_mapping_is_true_to_a_fiftieth_of_a_pixel() {
        for (code, affine) in [
            (32640, [1.0, 0.0, 344_000.5, 0.0, -1.0, 2_790_000.5]),
            (32633, [1.0, 0.0, 833_000.0, 0.0, -1.0, 6_660_000.0]),
            (3857, [1.2, 0.0, -13_610_655.0, 0.0, -1.2, 4_561_810.0]),
            (3857, [2.0, 0.0, 2_700_000.0, 0.0, -2.0, 11_000_000.0]),
            (4326, [1e-5, 0.0, 55.45, 0.0, -9e-6, 25.21]),
            (4326, [2.6e-5, 0.0, 20.0, 0.0, -9e-6, 70.0]),
            (3413, [1.0, 0.0, 40_000.0, 0.0, -1.0, -90_000.0]),
            (32640, [0.3, 0.4, 344_000.5, 0.4, -0.3, 2_790_000.5]),
        ] {
            let (_dir, map) = map(code, affine);
            for (size_px, m_per_px) in [(1536, 1.0), (1728, 1.0), (256, 6.0), (3072, 0.5), (1, 1.0), (129, 3.0)] {
                let centre = map.centre().unwrap().offset(Enu { east_m: 300.0, north_m: -200.0 });
                let spec = WindowSpec { centre, width_m: size_px as f64 * m_per_px, m_per_px };
                let lattice = Lattice::new(&map, &spec, size_px);
                let exact = Mapping::new(&map, &spec, size_px);
                for i in 0..400_usize {
                    let last = (size_px - 1) as f64;
                    let (x, y) = ((i * 37 % 400) as f64 / 399.0 * last, (i * 91 % 400) as f64 / 399.0 * last);
                    let (a, b) = (lattice.map_px(x, y), exact.map_px(x, y));
                    let error_px = (a[0] - b[0]).hypot(a[1] - b[1]) / lattice.map_px_per_px[0].max(lattice.map_px_per_px[1]);
                    assert!(error_px < 0.02, "EPSG:{code}, {size_px} px of {m_per_px} m: {error_px} px at {x}, {y}");
                }
            }
        }
    }
}
