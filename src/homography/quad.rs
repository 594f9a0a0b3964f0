//! Four corners, in the order TL, TR, BL, BR, and the frames in which they are written.

use super::{DltError, Homography, dlt};

/// Corner displacements `[x|y][top|bottom][left|right]`, cumulative, in stage-input map pixels, from the identity
/// corners (0, 0) .. (R - 1, R - 1). "Model bundle" in `ARCHITECTURE.md`.
pub type Displacement = [[[f64; 2]; 2]; 2];

/// Four points, TL, TR, BL, BR.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quad(pub [[f64; 2]; 4]);

impl Quad {
    /// Corners of the pixel square `0..=size-1` (inclusive corners).
    pub fn inclusive(size_px: usize) -> Self {
        let e = size_px as f64 - 1.0;
        Self([[0.0, 0.0], [e, 0.0], [0.0, e], [e, e]])
    }

    /// Outer edges of the pixel square: `-0.5 ..= size - 0.5`.
    pub fn edges(size_px: usize) -> Self {
        let (a, b) = (-0.5, size_px as f64 - 0.5);
        Self([[a, a], [b, a], [a, b], [b, b]])
    }

    /// Identity corners plus a displacement: inclusive corners in stage-input map pixels.
    pub fn displaced(size_px: usize, d: &Displacement) -> Self {
        let mut q = Self::inclusive(size_px);
        for (i, p) in q.0.iter_mut().enumerate() {
            p[0] += d[0][i / 2][i % 2];
            p[1] += d[1][i / 2][i % 2];
        }
        q
    }

    /// The mean of the corners.
    pub fn mean(&self) -> [f64; 2] {
        let s = self.0.iter().fold([0.0, 0.0], |s, p| [s[0] + p[0], s[1] + p[1]]);
        [s[0] / 4.0, s[1] / 4.0]
    }

    /// Whether every coordinate is finite.
    pub fn is_finite(&self) -> bool {
        self.0.iter().flatten().all(|v| v.is_finite())
    }

    /// Signed area, square pixels: positive where TL, TR, BR, BL run clockwise on the screen (y down).
    pub fn area_px2(&self) -> f64 {
        let [tl, tr, bl, br] = self.0;
        0.5 * ((br[0] - tl[0]) * (bl[1] - tr[1]) - (br[1] - tl[1]) * (bl[0] - tr[0]))
    }

    /// Whether the quad is strictly convex and not mirrored: each corner, walked TL, TR, BR, BL, turns right.
    pub fn is_convex(&self) -> bool {
        let [tl, tr, bl, br] = self.0;
        let turn = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]);
        let turns = [turn(tl, tr, br), turn(tr, br, bl), turn(br, bl, tl), turn(bl, tl, tr)];
        turns.iter().all(|&t| t > 0.0)
    }

    /// Rotation of the quad against an upright square, degrees, clockwise on the screen positive, -180..=180: the angle
    /// of the least-squares similarity. 0 for a quad without extent.
    pub fn rotation_deg(&self) -> f64 {
        let [tl, tr, bl, br] = self.0;
        let across = [tr[0] - tl[0] + br[0] - bl[0], tr[1] - tl[1] + br[1] - bl[1]];
        let down = [bl[0] - tl[0] + br[0] - tr[0], bl[1] - tl[1] + br[1] - tr[1]];
        (across[1] - down[0]).atan2(across[0] + down[1]).to_degrees()
    }

    /// Whether the point lies in the quad or on its border. Of use for convex quads only.
    pub fn contains(&self, x: f64, y: f64) -> bool {
        let [tl, tr, bl, br] = self.0;
        let inside = |a: [f64; 2], b: [f64; 2]| (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) >= 0.0;
        inside(tl, tr) && inside(tr, br) && inside(br, bl) && inside(bl, tl)
    }

    /// The homography from a square frame of `frame_size_px` to this quad of outer edges. Pixel centres are integers on
    /// both sides.
    ///
    /// # Errors
    /// [`DltError::Degenerate`] for a quad with three corners on a line or a number that is not finite.
    pub fn homography_from(&self, frame_size_px: usize) -> Result<Homography, DltError> {
        dlt(&Self::edges(frame_size_px).0, &self.0)
    }
}

/// Inclusive stage corners -> edges of window pixels at 1 m/px: left * alpha, (right + 1) * alpha, then - 0.5.
/// `alpha` = window pixels per stage pixel. A perfect fit then has scale 1.000 for every W_S.
pub fn box_of_inclusive(quad: &Quad, alpha: f64) -> Quad {
    let mut out = *quad;
    for (i, p) in out.0.iter_mut().enumerate() {
        let (right, bottom) = ((i % 2) as f64, (i / 2) as f64);
        p[0] = (p[0] + right) * alpha - 0.5;
        p[1] = (p[1] + bottom) * alpha - 0.5;
    }
    out
}

/// The inverse of [`box_of_inclusive`] and [`Quad::displaced`]: edges in window pixels at 1 m/px -> the displacement that
/// a stage of `stage_size_px` would have to give. `alpha` = window pixels per stage pixel.
pub fn displacement_of_box(edges: &Quad, stage_size_px: usize, alpha: f64) -> Displacement {
    let identity = Quad::inclusive(stage_size_px);
    let mut d = Displacement::default();
    for (i, (p, corner)) in edges.0.iter().zip(&identity.0).enumerate() {
        let (right, bottom) = (i % 2, i / 2);
        d[0][bottom][right] = (p[0] + 0.5) / alpha - right as f64 - corner[0];
        d[1][bottom][right] = (p[1] + 0.5) / alpha - bottom as f64 - corner[1];
    }
    d
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Published ground truth of a centred 512 m frame, R = 256: first and last inclusive corner.
    const PUBLISHED: [(usize, f64, f64); 3] =
        [(512, 0.0, 255.0), (1024, 64.0, 191.0), (1536, 256.0 / 3.0, 256.0 - 256.0 / 3.0 - 1.0)];

    fn square(first: f64, last: f64) -> Quad {
        Quad([[first, first], [last, first], [first, last], [last, last]])
    }

    #[test]
    fn a_perfect_fit_has_scale_one_for_every_window() -> Result<(), DltError> {
        for (window_px, first, last) in PUBLISHED {
            let alpha = window_px as f64 / 256.0;
            let edges = box_of_inclusive(&square(first, last), alpha);
            assert!((edges.area_px2().sqrt() - 512.0).abs() < 1e-9, "{window_px}: {edges:?}");
            let h = edges.homography_from(512)?;
            // Frame pixel (i, j) lies on window pixel (i + margin, j + margin): a pure shift by whole pixels.
            let margin = (window_px as f64 - 512.0) / 2.0;
            for (x, y) in [(0.0, 0.0), (511.0, 0.0), (255.5, 255.5), (100.0, 300.0)] {
                let [u, v] = h.apply(x, y);
                assert!((u - x - margin).abs() < 1e-9 && (v - y - margin).abs() < 1e-9, "{window_px}: ({x}, {y}) -> ({u}, {v})");
            }
            assert!((h.0[0][0] - 1.0).abs() < 1e-12 && (h.0[1][1] - 1.0).abs() < 1e-12);
        }
        Ok(())
    }

    #[test]
    fn the_published_corners_come_back_from_the_edges() {
        for (window_px, first, last) in PUBLISHED {
            let margin = (window_px as f64 - 512.0) / 2.0;
            let d = displacement_of_box(&square(margin - 0.5, margin + 511.5), 256, window_px as f64 / 256.0);
            let corners = Quad::displaced(256, &d);
            for (found, expected) in corners.0.iter().flatten().zip(square(first, last).0.iter().flatten()) {
                assert!((found - expected).abs() < 1e-9, "{window_px}: {corners:?}");
            }
        }
    }

    #[test]
    fn displacements_are_laid_out_axis_row_column() {
        let d = [[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 8.0]]];
        assert_eq!(Quad::displaced(256, &d), Quad([[1.0, 5.0], [257.0, 6.0], [3.0, 262.0], [259.0, 263.0]]));
    }

    #[test]
    fn area_orientation_rotation_and_inside() {
        let upright = Quad::edges(512);
        assert!(upright.is_convex());
        assert!((upright.area_px2() - 512.0 * 512.0).abs() < 1e-6);
        for angle_deg in [-170.0_f64, -10.0, 0.0, 0.5, 45.0, 90.0, 179.0] {
            // Clockwise on the screen: x right, y down.
            let (sin, cos) = angle_deg.to_radians().sin_cos();
            let turned = Quad(upright.0.map(|[x, y]| [30.0 + x * cos - y * sin, -7.0 + x * sin + y * cos]));
            assert!((turned.rotation_deg() - angle_deg).abs() < 1e-9, "{angle_deg}: {}", turned.rotation_deg());
            assert!(turned.is_convex());
            let [cx, cy] = turned.mean();
            assert!(turned.contains(cx, cy) && !turned.contains(cx + 600.0, cy));
        }
        let mirrored = Quad([upright.0[1], upright.0[0], upright.0[3], upright.0[2]]);
        assert!(!mirrored.is_convex() && mirrored.area_px2() < 0.0);
        let bow = Quad([upright.0[0], upright.0[1], upright.0[3], upright.0[2]]);
        assert!(!bow.is_convex());
        let dart = Quad([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [3.0, 3.0]]);
        assert!(!dart.is_convex());
    }
}
