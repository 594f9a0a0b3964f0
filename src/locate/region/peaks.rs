//! The highest places of a region.

use super::super::{NoFix, Reason};
use super::Layout;
use crate::map::WindowSpec;

/// The highest logit of every shift of a tile over the hypotheses, and whose it is.
pub struct Plane {
    /// Column and row of the tile.
    pub tile: [i64; 2],
    /// The tile's image.
    pub spec: WindowSpec,
    best: Vec<f32>,
    hypothesis: Vec<u16>,
}

/// A place that stands out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Which plane.
    pub plane: usize,
    /// Shift in its tile, cells: x, y.
    pub shift: [usize; 2],
    /// Its logit.
    pub logit: f64,
    /// Which hypothesis it is of.
    pub hypothesis: usize,
    /// Share of the region's posterior round it. The posterior is over places alone: of each the best hypothesis.
    pub mass: f64,
}

/// What a region holds.
#[derive(Debug, Clone, PartialEq)]
pub struct Peaks {
    /// The highest places, apart from each other, highest first.
    pub places: Vec<Place>,
    /// Ground on which the frame's middle was tried, square kilometres.
    pub searched_km2: f64,
}

impl Plane {
    /// Nothing tried yet.
    pub fn new(tile: [i64; 2], spec: WindowSpec, shifts: usize) -> Self {
        Self { tile, spec, best: vec![f32::NEG_INFINITY; shifts * shifts], hypothesis: vec![0; shifts * shifts] }
    }

    /// Takes the logits of a hypothesis where they are allowed and higher. Not finite ones are refused.
    pub fn take(&mut self, logits: &[f32], hypothesis: u16, allowed: impl Fn(usize) -> bool) -> Result<(), NoFix> {
        for (i, (logit, (best, of))) in logits.iter().zip(self.best.iter_mut().zip(&mut self.hypothesis)).enumerate() {
            if !logit.is_finite() {
                let detail = format!("search: log-posterior: expected finite numbers, found {logit}");
                return Err(NoFix::new(Reason::NonFinite, detail));
            }
            if *logit > *best && allowed(i) {
                (*best, *of) = (*logit, hypothesis);
            }
        }
        Ok(())
    }
}

/// The `wanted` highest places, each at least `apart_m` from those before it (non-maximum suppression; of equals the first).
/// A place's mass is that of the square of `radius` cells round it, as far as its own tile goes.
pub fn peaks(planes: &[Plane], layout: &Layout, wanted: usize, apart_m: f64, radius: usize) -> Peaks {
    let shifts = layout.shifts;
    let apart = apart_m / layout.cell_m();
    let global = |plane: &Plane, i: usize| {
        let local = [i % shifts, i / shifts];
        [0, 1].map(|axis| plane.tile[axis] as f64 * shifts as f64 + local[axis] as f64)
    };
    let mut places: Vec<Place> = Vec::new();
    let mut taken: Vec<[f64; 2]> = Vec::new();
    while places.len() < wanted {
        let mut highest: Option<(f32, usize, usize)> = None;
        for (p, plane) in planes.iter().enumerate() {
            for (i, &logit) in plane.best.iter().enumerate() {
                let higher = logit.is_finite() && highest.is_none_or(|(most, ..)| logit > most);
                let clear = |at: [f64; 2]| taken.iter().all(|t| (t[0] - at[0]).hypot(t[1] - at[1]) >= apart);
                if higher && clear(global(plane, i)) {
                    highest = Some((logit, p, i));
                }
            }
        }
        let Some((logit, plane, i)) = highest else { break };
        let Some(of) = planes.get(plane) else { break };
        taken.push(global(of, i));
        let hypothesis = of.hypothesis.get(i).copied().unwrap_or(0).into();
        let shift = [i % shifts, i / shifts];
        places.push(Place { plane, shift, logit: logit.into(), hypothesis, mass: 0.0 });
    }
    let top = places.first().map_or(0.0, |place| place.logit);
    let weight = |logit: f32| if logit.is_finite() { (f64::from(logit) - top).exp() } else { 0.0 };
    let total: f64 = planes.iter().flat_map(|plane| &plane.best).map(|logit| weight(*logit)).sum();
    for place in &mut places {
        let Some(plane) = planes.get(place.plane) else { continue };
        let [xs, ys] = place.shift.map(|v| v.saturating_sub(radius)..(v + radius + 1).min(shifts));
        let square = ys.flat_map(|y| xs.clone().map(move |x| y * shifts + x));
        place.mass = square.filter_map(|i| plane.best.get(i)).map(|logit| weight(*logit)).sum::<f64>() / total;
    }
    let tried = planes.iter().flat_map(|plane| &plane.best).filter(|logit| logit.is_finite()).count();
    Peaks { places, searched_km2: tried as f64 * layout.cell_m().powi(2) / 1e6 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geo::LatLon;

    const LAYOUT: Layout = Layout { block: 24, shifts: 16, cells: 8, stride: 2, frame_px: 16, m_per_px: 5.0 };

    fn plane(tile: [i64; 2], high: &[(usize, usize, f32)]) -> Plane {
        let centre = LatLon { lat_deg: 25.0, lon_deg: 55.0 };
        let mut plane = Plane::new(tile, WindowSpec { centre, width_m: 1.0, m_per_px: 1.0 }, 16);
        let mut logits = vec![0.0; 256];
        for (x, y, logit) in high {
            logits[y * 16 + x] = *logit;
        }
        plane.take(&logits, 0, |i| i != 0).unwrap();
        plane
    }

    #[test]
    fn the_highest_come_first_and_neighbours_across_a_seam_are_one_place() {
        // (15, 3) of the first tile and (0, 4) of the next are 10 m and 10 m apart.
        let planes = [plane([0, 0], &[(15, 3, 20.0), (2, 9, 12.0)]), plane([1, 0], &[(0, 4, 19.0), (9, 9, 15.0)])];
        let found = peaks(&planes, &LAYOUT, 3, 60.0, 2);
        let at: Vec<_> = found.places.iter().map(|p| (p.plane, p.shift, p.logit)).collect();
        assert_eq!(at, [(0, [15, 3], 20.0), (1, [9, 9], 15.0), (0, [2, 9], 12.0)]);
        assert!((found.searched_km2 - 2.0 * 255.0 * 1e-4).abs() < 1e-12, "the corner is not allowed: {found:?}");
        let ratio = found.places[1].mass / found.places[0].mass;
        assert!((ratio / (-5.0f64).exp() - 1.0).abs() < 1e-3, "{ratio}");
        assert!(found.places[0].mass > 0.7 && found.places[0].mass < 0.74, "a neighbour holds exp(-1): {found:?}");
    }

    #[test]
    fn the_best_hypothesis_is_kept_and_what_is_no_number_is_refused() {
        let mut plane = plane([0, 0], &[(5, 5, 3.0)]);
        let mut second = vec![-1.0; 256];
        second[5 * 16 + 6] = 4.0;
        plane.take(&second, 7, |_| true).unwrap();
        let found = peaks(&[plane], &LAYOUT, 1, 10.0, 0).places[0];
        assert_eq!((found.shift, found.hypothesis), ([6, 5], 7));
        let mut plane =
            Plane::new([0, 0], WindowSpec { centre: LatLon { lat_deg: 0.0, lon_deg: 0.0 }, width_m: 1.0, m_per_px: 1.0 }, 2);
        assert_eq!(plane.take(&[0.0, f32::NAN, 0.0, 0.0], 0, |_| true).unwrap_err().reason, Reason::NonFinite);
        assert!(peaks(&[], &LAYOUT, 3, 10.0, 2).places.is_empty());
    }
}
