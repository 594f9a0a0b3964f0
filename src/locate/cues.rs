//! Numbers that speak for or against a match and need no network: structure of frame and map before any inference,
//! agreement of both after it, shape of the quad.

use super::inputs::{FrameView, WindowView};
use super::posterior::wrap_deg;
use crate::homography::{Homography, Quad};

/// Cells along a side of the grid on which frame and map are compared: 4 m each at a 512 m frame.
const GRID: usize = 128;
/// Cells that are averaged for the coarse structure: 16 m.
const COARSE: usize = 4;

/// Structure of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Texture {
    /// Standard deviation of the means over 16 m, grey levels.
    pub coarse: f64,
    /// That over the standard deviation of the means over 4 m: near 1 for things that have a size, 1/4 for white noise.
    pub smoothness: f64,
}

/// A grid of cell means; `None` where less than half of the cell was seen.
struct Grid {
    side: usize,
    values: Vec<Option<f32>>,
}

impl Grid {
    /// Means of a grey picture over `side x side` cells.
    fn of_frame(frame: &FrameView<'_>, side: usize) -> Self {
        let step = (frame.size_px / side).max(1);
        let cell = |i: usize| {
            let (x0, y0) = (i % side * step, i / side * step);
            let (mut sum, mut seen) = (0u32, 0u32);
            for y in y0..y0 + step {
                let row = y * frame.size_px + x0..y * frame.size_px + x0 + step;
                let (Some(gray), Some(mask)) = (frame.gray.get(row.clone()), frame.seen.get(row)) else { continue };
                for (gray, mask) in gray.iter().zip(mask).filter(|(_, mask)| **mask != 0) {
                    sum += u32::from(*gray);
                    seen += u32::from(*mask != 0);
                }
            }
            (2 * seen as usize >= step * step).then(|| sum as f32 / seen as f32)
        };
        Self { side, values: (0..side * side).map(cell).collect() }
    }

    /// Means over `by x by` cells of which at least half have a value.
    fn coarser(&self, by: usize) -> Self {
        let side = self.side / by;
        let cell = |i: usize| {
            let (x0, y0) = (i % side * by, i / side * by);
            let inside = (0..by * by).filter_map(|j| self.at(x0 + j % by, y0 + j / by));
            let (n, sum) = inside.fold((0usize, 0.0f32), |(n, sum), v| (n + 1, sum + v));
            (2 * n >= by * by).then(|| sum / n as f32)
        };
        Self { side, values: (0..side * side).map(cell).collect() }
    }

    fn at(&self, x: usize, y: usize) -> Option<f32> {
        if x < self.side { self.values.get(y * self.side + x).copied().flatten() } else { None }
    }

    fn std(&self) -> f64 {
        let values = || self.values.iter().flatten().map(|v| f64::from(*v));
        let (n, sum) = values().fold((0.0, 0.0), |(n, s), v| (n + 1.0, s + v));
        if n == 0.0 {
            return 0.0;
        }
        let mean = sum / n;
        (values().map(|v| (v - mean) * (v - mean)).sum::<f64>() / n).sqrt()
    }

    fn texture(&self) -> Texture {
        let (fine, coarse) = (self.std(), self.coarser(COARSE).std());
        Texture { coarse, smoothness: if fine > 0.0 { coarse / fine } else { 0.0 } }
    }

    /// Central differences: x, y.
    fn gradient(&self, x: usize, y: usize) -> Option<[f32; 2]> {
        let (left, up) = (x.checked_sub(1)?, y.checked_sub(1)?);
        Some([self.at(x + 1, y)? - self.at(left, y)?, self.at(x, y + 1)? - self.at(x, up)?])
    }
}

/// Structure of a frame, over what was seen.
pub fn frame_texture(frame: &FrameView<'_>) -> Texture {
    Grid::of_frame(frame, GRID).texture()
}

/// Structure of the map within `radius_px` of a window pixel (with the window's margin), in luminance; where the map has
/// no data it has none.
pub fn map_texture(window: &WindowView<'_>, centre_px: [f64; 2], radius_px: f64) -> Texture {
    let step = 4usize;
    let side = window.size_px / step;
    let cell = |i: usize| {
        let (x, y) = (i % side * step, i / side * step);
        let (cx, cy) = (x as f64 + 1.5 - centre_px[0], y as f64 + 1.5 - centre_px[1]);
        if cx.hypot(cy) > radius_px {
            return None;
        }
        let mut sum = 0u32;
        for row in y..y + step {
            let at = (row * window.size_px + x) * 3;
            sum += window.rgb.get(at..at + 3 * step)?.iter().map(|v| u32::from(*v)).sum::<u32>();
        }
        (sum > 0).then(|| sum as f32 / (3 * step * step) as f32)
    };
    Grid { side, values: (0..side * side).map(cell).collect() }.texture()
}

/// Agreement of the frame's edges with the map's where the homography lays them, -1..=1: mean of `cos 2 (a - b)` over the
/// cells, a and b being the directions of both gradients, weighted by their strengths. Twice the angle, because hot and
/// cold may be bright or dark. 0 is what chance gives.
pub fn gradient_agreement(frame: &FrameView<'_>, window: &WindowView<'_>, margin_px: f64, homography: &Homography) -> f64 {
    let gray = Grid::of_frame(frame, GRID);
    let step = frame.size_px as f64 / GRID as f64;
    let map = |i: usize| {
        let [x, y] = homography.apply(((i % GRID) as f64 + 0.5) * step - 0.5, ((i / GRID) as f64 + 0.5) * step - 0.5);
        mean_luminance(window, x + margin_px, y + margin_px)
    };
    let map = Grid { side: GRID, values: (0..GRID * GRID).map(map).collect() };
    let (mut agreement, mut weight) = (0.0f64, 0.0f64);
    for (x, y) in (0..GRID * GRID).map(|i| (i % GRID, i / GRID)) {
        let (Some([ax, ay]), Some([bx, by])) = (gray.gradient(x, y), map.gradient(x, y)) else { continue };
        // |a| |b| cos 2 (a - b), from the squares of both as complex numbers, over |a| |b|.
        let (a2, b2) = ([ax * ax - ay * ay, 2.0 * ax * ay], [bx * bx - by * by, 2.0 * bx * by]);
        let strength = (ax.hypot(ay) * bx.hypot(by)).sqrt();
        let length = (a2[0].hypot(a2[1]) * b2[0].hypot(b2[1])).max(1e-12);
        agreement += f64::from(strength * (a2[0] * b2[0] + a2[1] * b2[1]) / length);
        weight += f64::from(strength);
    }
    if weight > 0.0 { agreement / weight } else { 0.0 }
}

/// Mean luminance of the 4 x 4 pixels about a place; `None` where any of them is no map.
fn mean_luminance(window: &WindowView<'_>, x: f64, y: f64) -> Option<f32> {
    let (x0, y0) = ((x - 1.5).round(), (y - 1.5).round());
    let most = window.size_px as f64 - 4.0;
    if !(x0 >= 0.0 && y0 >= 0.0 && x0 <= most && y0 <= most) {
        return None;
    }
    let (x0, y0) = (x0 as usize, y0 as usize);
    let mut sum = 0u32;
    for row in y0..y0 + 4 {
        let at = (row * window.size_px + x0) * 3;
        sum += window.rgb.get(at..at + 12)?.iter().map(|v| u32::from(*v)).sum::<u32>();
    }
    (sum > 0).then(|| sum as f32 / 48.0)
}

/// Shape of the quad against what was assumed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shape {
    /// |ln(scale)|: by how much the footprint differs from the assumed one.
    pub scale_error: f64,
    /// |turn| against the assumed yaw, degrees.
    pub turn_deg: f64,
    /// Least ratio of opposite sides, 0..=1.
    pub side_ratio: f64,
}

/// Measures a quad of the frame's edges.
pub fn shape(quad: &Quad, side_m: f64) -> Shape {
    let [tl, tr, bl, br] = quad.0;
    let length = |a: [f64; 2], b: [f64; 2]| (b[0] - a[0]).hypot(b[1] - a[1]);
    let ratio = |a: f64, b: f64| a.min(b) / a.max(b);
    let sides = ratio(length(tl, tr), length(bl, br)).min(ratio(length(tl, bl), length(tr, br)));
    Shape {
        scale_error: (quad.area_px2().abs().sqrt() / side_m).ln().abs(),
        turn_deg: wrap_deg(quad.rotation_deg()).abs(),
        side_ratio: sides,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    const SIDE: usize = 512;

    /// Waves of 40 to 90 m in every direction, or white noise.
    fn picture(noise: bool) -> Vec<u8> {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let waves: Vec<[f64; 3]> = (0..12)
            .map(|_| {
                let (length, way) = (rng.random_range(40.0..90.0), rng.random_range(0.0..std::f64::consts::TAU));
                let k = std::f64::consts::TAU / length;
                [k * f64::cos(way), k * f64::sin(way), rng.random_range(0.0..7.0)]
            })
            .collect();
        let sum = |x: f64, y: f64| waves.iter().map(|[a, b, c]| (a * x + b * y + c).sin()).sum::<f64>();
        (0..SIDE * SIDE)
            .map(
                |i| {
                    if noise {
                        rng.random_range(0..255)
                    } else {
                        (128.0 + 30.0 * sum((i % SIDE) as f64, (i / SIDE) as f64)) as u8
                    }
                },
            )
            .collect()
    }

    fn window(gray: &[u8], shift: usize) -> Vec<u8> {
        (0..SIDE * SIDE)
            .flat_map(|i| {
                let v = 255 - gray[(i / SIDE).saturating_sub(shift) * SIDE + (i % SIDE).saturating_sub(shift)];
                [v.max(1), (v / 2).max(1), v.max(1)]
            })
            .collect()
    }

    const STAY: Homography = Homography([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);

    #[test]
    fn noise_has_no_coarse_structure_and_waves_have() {
        let seen = vec![1; SIDE * SIDE];
        let texture = |noise: bool| frame_texture(&FrameView { size_px: SIDE, gray: &picture(noise), seen: &seen });
        let (noise, waves) = (texture(true), texture(false));
        assert!(noise.smoothness < 0.35 && noise.coarse < 8.0, "{noise:?}");
        assert!(waves.smoothness > 0.7 && waves.coarse > 30.0, "{waves:?}");
        let nothing = frame_texture(&FrameView { size_px: SIDE, gray: &picture(true), seen: &vec![0; SIDE * SIDE] });
        assert_eq!(nothing, Texture { coarse: 0.0, smoothness: 0.0 });
    }

    #[test]
    fn edges_agree_at_the_right_place_and_not_elsewhere_or_beyond_the_map() {
        let (gray, seen) = (picture(false), vec![1; SIDE * SIDE]);
        let frame = FrameView { size_px: SIDE, gray: &gray, seen: &seen };
        let agreement = |shift: usize| {
            let rgb = window(&gray, shift);
            gradient_agreement(&frame, &WindowView { size_px: SIDE, rgb: &rgb }, 0.0, &STAY)
        };
        assert!(agreement(0) > 0.9, "{}", agreement(0));
        assert!(agreement(20).abs() < 0.3, "{}", agreement(20));
        let away = Homography([[1.0, 0.0, 1e4], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let rgb = window(&gray, 0);
        assert_eq!(gradient_agreement(&frame, &WindowView { size_px: SIDE, rgb: &rgb }, 0.0, &away), 0.0);
    }

    #[test]
    fn map_structure_is_that_of_the_disc() {
        let gray = picture(false);
        let mut rgb = window(&gray, 0);
        rgb[..SIDE * SIDE / 2 * 3].fill(90);
        let window = WindowView { size_px: SIDE, rgb: &rgb };
        assert!(map_texture(&window, [256.0, 100.0], 90.0).coarse < 1e-3);
        assert!(map_texture(&window, [256.0, 400.0], 90.0).coarse > 20.0);
    }

    #[test]
    fn a_square_as_assumed_has_no_error() {
        assert_eq!(shape(&Quad::edges(SIDE), SIDE as f64), Shape { scale_error: 0.0, turn_deg: 0.0, side_ratio: 1.0 });
    }
}
