//! Which window a prior is searched in, and what is kept of it while it stays.

use super::inputs::WindowView;
use super::pair::{MapSide, PairError, Steps, encode_map};
use crate::geo::{Enu, LatLon};
use crate::map::{MapCache, MapError, Window, WindowSpec};
use crate::model::Bundle;
use std::sync::Arc;

/// Longest lattice step, metres.
const MAX_STEP_M: f64 = 512.0;
/// Shortest: below this, snapping saves nothing.
const MIN_STEP_M: f64 = 64.0;
/// Encoded windows that are kept, unless told otherwise: a vehicle on the rim between two of them goes back and forth.
const KEPT: usize = 2;

/// The middle of the window for a prior: a function of the prior alone, so that answers do not depend on history.
///
/// The search disc must stay inside: the slack is `(W_S - frame) / 2 - R` per axis. The prior is snapped to a lattice in ENU
/// about the map's middle with the longest step that is a power of two, at most 512 m, and has half a step of at most the
/// slack; then the map's features are kept while the vehicle flies within a cell. With less than 32 m of slack the window is
/// centred on the prior itself.
pub fn window_centre(map_centre: LatLon, prior: LatLon, slack_m: f64) -> LatLon {
    let mut step_m = MAX_STEP_M;
    while step_m / 2.0 > slack_m {
        step_m /= 2.0;
        if step_m < MIN_STEP_M {
            return prior;
        }
    }
    let at = map_centre.enu_to(prior);
    let snap = |v: f64| (v / step_m).round() * step_m;
    map_centre.offset(Enu { east_m: snap(at.east_m), north_m: snap(at.north_m) })
}

/// An encoded window.
pub struct Kept {
    /// Window and margin.
    pub window: Arc<Window>,
    /// The coarse stage's side of it.
    pub map: MapSide,
}

/// The map and the windows of it that are encoded.
pub struct Windows {
    /// The map.
    pub map: MapCache,
    kept: Vec<(WindowSpec, Kept)>,
    keep: usize,
    encodes: u64,
}

/// Why there is no window.
#[derive(Debug, thiserror::Error)]
pub enum WindowError {
    /// The map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The encoder.
    #[error(transparent)]
    Pair(#[from] PairError),
}

impl Windows {
    /// None encoded yet.
    pub fn new(map: MapCache) -> Self {
        Self { map, kept: Vec::new(), keep: KEPT, encodes: 0 }
    }

    /// Keeps so many encoded windows from now on; at least the usual two.
    pub fn keep(&mut self, count: usize) {
        self.keep = count.max(KEPT);
    }

    /// How many windows were encoded so far.
    pub fn encodes(&self) -> u64 {
        self.encodes
    }

    /// The window, encoded; made or kept.
    pub fn get(&mut self, spec: &WindowSpec, bundle: &mut Bundle, steps: &mut Steps) -> Result<&mut Kept, WindowError> {
        match self.kept.iter().position(|(kept, _)| kept == spec) {
            Some(at) => self.kept[..=at].rotate_right(1),
            None => {
                let window = self.map.window(spec)?;
                steps.done("window");
                let map = encode_map(bundle, &WindowView { size_px: window.size_px, rgb: &window.rgb })?;
                steps.done("coarse_map");
                self.encodes += 1;
                self.kept.truncate(self.keep - 1);
                self.kept.insert(0, (*spec, Kept { window, map }));
            }
        }
        match self.kept.first_mut() {
            Some((_, kept)) => Ok(kept),
            None => Err(WindowError::Pair(PairError::NonFinite { what: "window", found: "none kept".into() })),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAP: LatLon = LatLon { lat_deg: 25.2, lon_deg: 55.3 };

    #[test]
    fn the_window_stays_within_its_slack_and_on_the_lattice() {
        for slack_m in [32.0, 63.9, 64.0, 130.0, 256.0, 400.0] {
            for (east_m, north_m) in [(0.0, 0.0), (777.7, -1234.5), (-5000.2, 31.9)] {
                let prior = MAP.offset(Enu { east_m, north_m });
                let centre = window_centre(MAP, prior, slack_m);
                let off = centre.enu_to(prior);
                assert!(off.east_m.abs() <= slack_m + 0.01 && off.north_m.abs() <= slack_m + 0.01, "{slack_m} {off:?}");
                let at = MAP.enu_to(centre);
                assert!((at.east_m / 64.0 - (at.east_m / 64.0).round()).abs() < 1e-6, "{at:?}");
            }
        }
    }

    #[test]
    fn without_slack_the_window_is_centred_on_the_prior() {
        let prior = MAP.offset(Enu { east_m: 12.0, north_m: 34.0 });
        for slack_m in [31.9, 0.0, -100.0, f64::NAN] {
            assert_eq!(
                window_centre(MAP, prior, slack_m),
                if slack_m.is_nan() { window_centre(MAP, prior, 256.0) } else { prior }
            );
        }
    }

    #[test]
    fn a_vehicle_that_moves_within_a_cell_keeps_its_window() {
        let centres: Vec<_> =
            (0..10).map(|i| window_centre(MAP, MAP.offset(Enu { east_m: f64::from(i) * 20.0, north_m: 5.0 }), 300.0)).collect();
        assert!(centres.iter().all(|c| *c == centres[0]));
    }
}
