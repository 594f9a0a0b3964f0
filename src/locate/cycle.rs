//! Map to frame and back: the map's features under the middle of the matched frame, searched for in the frame's own.
//!
//! Forward, the whole frame chose a place in the map. Backward, a patch of the map at that place must choose the same place
//! in the frame; where the forward match rests on chance, it does not.

use crate::model::Tensor;

/// Share of the frame's side that the patch has.
const PATCH_SHARE: f64 = 0.5;
/// Cells searched on each side.
const REACH: i64 = 10;

/// What came back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cycle {
    /// Distance from where it should be, feature cells.
    pub distance_cells: f64,
    /// Share of the posterior within two cells of its peak.
    pub mass: f64,
}

/// `map` `[1, C, H, W]`; `frame` is one item of `[B, C, n, n]`; `shift` the forward match in cells (frame cell 0 on map cell
/// `shift`), to a fraction of a cell. `None` where shapes do not fit.
pub fn cycle(map: &Tensor, frame: &[f32], cells: usize, shift: [f64; 2]) -> Option<Cycle> {
    let [_, channels, height, width] = map.shape[..] else { return None };
    if frame.len() != channels * cells * cells || !shift.iter().all(|s| s.abs() < 1e5) {
        return None;
    }
    let whole = [shift[0].round(), shift[1].round()];
    let patch = (cells as f64 * PATCH_SHARE) as usize;
    let from = (cells - patch) / 2;
    let side = (2 * REACH + 1) as usize;
    let mut scores = vec![0.0f32; side * side];
    let plane = height * width;
    for channel in 0..channels {
        let frame = frame.get(channel * cells * cells..(channel + 1) * cells * cells)?;
        let map = map.data.get(channel * plane..(channel + 1) * plane)?;
        for y in from..from + patch {
            let row = y as i64 + whole[1] as i64;
            let column = from as i64 + whole[0] as i64;
            // What lies beyond the map is zero.
            if row < 0 || row >= height as i64 || column < 0 || column + patch as i64 > width as i64 {
                continue;
            }
            let start = row as usize * width + column as usize;
            let patch_row = map.get(start..start + patch)?;
            for oy in -REACH..=REACH {
                let at = y as i64 + oy;
                if !(0..cells as i64).contains(&at) {
                    continue;
                }
                let line = frame.get(at as usize * cells..(at as usize + 1) * cells)?;
                for ox in -REACH..=REACH {
                    let first = from as i64 + ox;
                    let Some(piece) = usize::try_from(first).ok().and_then(|first| line.get(first..first + patch)) else {
                        continue;
                    };
                    let sum: f32 = patch_row.iter().zip(piece).map(|(a, b)| a * b).sum();
                    if let Some(score) = scores.get_mut(((oy + REACH) * side as i64 + ox + REACH) as usize) {
                        *score += sum;
                    }
                }
            }
        }
    }
    // The frame's features carry the weight of all its cells; a patch has its share of them.
    let gain = (cells * cells) as f32 / (patch * patch) as f32;
    let (best, top) =
        scores.iter().enumerate().fold((0, f32::NEG_INFINITY), |best, (i, s)| if *s > best.1 { (i, *s) } else { best });
    if !top.is_finite() {
        return None;
    }
    let (bx, by) = ((best % side) as i64, (best / side) as i64);
    let (mut total, mut near, mut centroid) = (0.0f64, 0.0f64, [0.0f64; 2]);
    for (i, score) in scores.iter().enumerate() {
        let weight = f64::from((score - top) * gain).exp();
        let (dx, dy) = ((i % side) as i64 - bx, (i / side) as i64 - by);
        total += weight;
        if dx.abs() <= 2 && dy.abs() <= 2 {
            near += weight;
            centroid = [centroid[0] + weight * dx as f64, centroid[1] + weight * dy as f64];
        }
    }
    let found = [(bx - REACH) as f64 + centroid[0] / near, (by - REACH) as f64 + centroid[1] / near];
    // Forward the frame lay at `shift`; the patch was cut at whole cells, so it must be found where the rest is made up.
    let expected = [whole[0] - shift[0], whole[1] - shift[1]];
    Some(Cycle { distance_cells: (found[0] - expected[0]).hypot(found[1] - expected[1]), mass: near / total })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    const CELLS: usize = 48;

    fn random(len: usize, seed: u64) -> Vec<f32> {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        (0..len).map(|_| rng.random_range(-1.0f32..1.0)).collect()
    }

    #[test]
    fn a_frame_cut_from_the_map_comes_back_and_another_does_not() {
        let (channels, side) = (8, 100);
        let map = Tensor { shape: vec![1, channels, side, side], data: random(channels * side * side, 1) };
        let cut: Vec<f32> = (0..channels * CELLS * CELLS)
            .map(|i| {
                let (c, y, x) = (i / CELLS / CELLS, i / CELLS % CELLS, i % CELLS);
                map.data[c * side * side + (y + 20) * side + x + 31] / 100.0
            })
            .collect();
        let found = cycle(&map, &cut, CELLS, [31.0, 20.0]).unwrap();
        assert!(found.distance_cells < 0.2 && found.mass > 0.9, "{found:?}");
        // Forward said three cells too far east: backward it is three cells off.
        let found = cycle(&map, &cut, CELLS, [34.0, 20.0]).unwrap();
        assert!((found.distance_cells - 3.0).abs() < 0.2, "{found:?}");
        let other: Vec<f32> = random(channels * CELLS * CELLS, 9).iter().map(|v| v / 100.0).collect();
        assert!(cycle(&map, &other, CELLS, [31.0, 20.0]).unwrap().mass < 0.9);
    }

    #[test]
    fn shapes_that_do_not_fit_and_places_beyond_the_map_are_no_panic() {
        let map = Tensor { shape: vec![1, 2, 50, 50], data: random(2 * 50 * 50, 1) };
        assert!(cycle(&map, &[0.0; 7], CELLS, [0.0; 2]).is_none());
        assert!(cycle(&map, &random(2 * CELLS * CELLS, 2), CELLS, [f64::NAN, 0.0]).is_none());
        for shift in [[-900.0, 3.0], [49.0, 49.0], [-47.0, -47.0]] {
            assert!(cycle(&map, &random(2 * CELLS * CELLS, 2), CELLS, shift).is_some());
        }
    }
}
