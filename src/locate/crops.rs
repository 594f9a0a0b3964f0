//! The frame again with parts of it covered: what a match says that does not rest on any one part.
//!
//! CropTTA of UASTHN (Xiao et al., ICRA 2025) takes the frame and four crops of it, three quarters of the side each. Here a
//! crop is a mask: what is covered counts as unseen, the geometry stays, and all five go through the matcher as one batch
//! against the same map features.

use crate::homography::Displacement;
use crate::model::Tensor;

/// Share of the side that a crop keeps: 192 of 256 px.
const KEPT_SHARE: f64 = 0.75;
/// The frame itself and its four corners.
pub const COUNT: usize = 5;

/// `[1, 2, n, n]` (gray, seen) -> `[5, 2, n, n]`: the frame, then its top-left, top-right, bottom-left and bottom-right
/// crop. `None` for another shape.
pub fn batch(frame: &Tensor) -> Option<Tensor> {
    let [1, 2, n, width] = frame.shape[..] else { return None };
    if n != width || frame.data.len() != 2 * n * n {
        return None;
    }
    let kept = (n as f64 * KEPT_SHARE).round() as usize;
    let mut data = Vec::with_capacity(COUNT * frame.data.len());
    data.extend_from_slice(&frame.data);
    for (left, top) in [(0, 0), (n - kept, 0), (0, n - kept), (n - kept, n - kept)] {
        for plane in frame.data.chunks_exact(n * n) {
            for (y, row) in plane.chunks_exact(n).enumerate() {
                let inside = (top..top + kept).contains(&y);
                data.extend(
                    row.iter().enumerate().map(|(x, v)| if inside && (left..left + kept).contains(&x) { *v } else { 0.0 }),
                );
            }
        }
    }
    Some(Tensor { shape: vec![COUNT, 2, n, n], data })
}

/// How far the five differ, in the displacements' pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Root mean square distance of a corner from its mean, mean over the corners.
    pub corners_px: f64,
    /// The same of the middle.
    pub middle_px: f64,
}

/// Spread of corner displacements over the crops.
pub fn spread(displacements: &[Displacement]) -> Spread {
    let n = displacements.len().max(1) as f64;
    let rms = |points: &dyn Fn(&Displacement) -> [f64; 2]| {
        let sum = displacements.iter().map(points).fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]]);
        let mean = sum.map(|s| s / n);
        (displacements.iter().map(points).map(|p| (p[0] - mean[0]).powi(2) + (p[1] - mean[1]).powi(2)).sum::<f64>() / n).sqrt()
    };
    let corner = |row: usize, column: usize| move |d: &Displacement| [d[0][row][column], d[1][row][column]];
    let corners = [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(row, column)| rms(&corner(row, column)));
    let middle = |d: &Displacement| d.map(|axis| axis.iter().flatten().sum::<f64>() / 4.0);
    Spread { corners_px: corners.iter().sum::<f64>() / 4.0, middle_px: rms(&middle) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crop_keeps_its_corner_and_covers_the_rest() {
        let n = 8;
        let frame = Tensor { shape: vec![1, 2, n, n], data: (0..2 * n * n).map(|i| 1.0 + i as f32).collect() };
        let five = batch(&frame).unwrap();
        assert_eq!(five.shape, [5, 2, n, n]);
        assert_eq!(five.data[..2 * n * n], frame.data[..]);
        let at = |item: usize, channel: usize, x: usize, y: usize| five.data[((item * 2 + channel) * n + y) * n + x];
        assert_eq!((at(1, 0, 0, 0), at(1, 0, 6, 0), at(1, 1, 5, 5)), (1.0, 0.0, frame.data[n * n + 5 * n + 5]));
        assert_eq!((at(4, 0, 1, 7), at(4, 0, 2, 2), at(4, 1, 7, 7)), (0.0, frame.data[2 * n + 2], frame.data[2 * n * n - 1]));
        assert!(batch(&Tensor { shape: vec![1, 3, n, n], data: vec![0.0; 3 * n * n] }).is_none());
    }

    #[test]
    fn spread_is_that_of_points() {
        let same = [[[1.0, 1.0], [1.0, 1.0]], [[2.0, 2.0], [2.0, 2.0]]];
        assert_eq!(spread(&[same; 5]), Spread { corners_px: 0.0, middle_px: 0.0 });
        let mut moved = same;
        moved[0] = [[5.0, 5.0], [5.0, 5.0]];
        let found = spread(&[same, moved]);
        assert_eq!(found, Spread { corners_px: 2.0, middle_px: 2.0 });
    }
}
