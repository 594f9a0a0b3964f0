//! Windows and decoded tiles that are kept, within a bound of bytes.

use super::tiles::Tiles;
use super::{GeoTiff, MapError, Window, WindowSpec, coverage, resample};
use crate::geo::LatLon;
use std::collections::VecDeque;
use std::sync::Arc;

/// Windows kept: the three widths of the ladder.
const WINDOWS_KEPT: usize = 3;

/// A map with what was decoded of it.
pub struct MapCache {
    map: GeoTiff,
    tiles: Tiles,
    /// The last windows, newest first.
    windows: VecDeque<Arc<Window>>,
}

impl MapCache {
    /// A cache over `map` that holds at most `capacity_bytes` of decoded tiles.
    pub fn new(map: GeoTiff, capacity_bytes: usize) -> Self {
        let tiles = Tiles::new(&map, capacity_bytes);
        Self { map, tiles, windows: VecDeque::with_capacity(WINDOWS_KEPT) }
    }

    /// The map.
    pub fn map(&self) -> &GeoTiff {
        &self.map
    }

    /// The window, made or kept: the last few windows stay, the same spec returns the same `Arc`.
    pub fn window(&mut self, spec: &WindowSpec) -> Result<Arc<Window>, MapError> {
        if let Some(i) = self.windows.iter().position(|w| w.spec == *spec)
            && let Some(window) = self.windows.remove(i)
        {
            self.windows.push_front(window.clone());
            return Ok(window);
        }
        let window = Arc::new(resample::render(&self.map, &mut self.tiles, spec)?);
        self.windows.truncate(WINDOWS_KEPT - 1);
        self.windows.push_front(window.clone());
        Ok(window)
    }

    /// Whether anywhere within `radius_m` of `centre` a north-up square of `footprint_m` lies at least `share` on
    /// valid map: the test behind the reason `off_map`. Coarse (footprints are judged by probes a 64th of their side apart),
    /// on the map's mask.
    pub fn can_hold(&mut self, centre: LatLon, radius_m: f64, footprint_m: f64, share: f64) -> Result<bool, MapError> {
        coverage::can_hold(&self.map, &mut self.tiles, centre, radius_m, footprint_m, share)
    }
}
