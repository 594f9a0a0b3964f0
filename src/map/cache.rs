//! Windows and decoded tiles that are kept, within a bound of bytes.

use super::{GeoTiff, MapError, Window, WindowSpec};
use crate::geo::LatLon;
use std::sync::Arc;

/// A map with what was decoded of it.
pub struct MapCache {}

impl MapCache {
    /// A cache over `map` that holds at most `capacity_bytes` of decoded tiles.
    pub fn new(map: GeoTiff, capacity_bytes: usize) -> Self {
        let _ = (map, capacity_bytes);
        todo!("map")
    }
    /// The map.
    pub fn map(&self) -> &GeoTiff {
        todo!("map")
    }
    /// The window, made or kept: the last few windows stay, the same spec returns the same `Arc`.
    pub fn window(&mut self, spec: &WindowSpec) -> Result<Arc<Window>, MapError> {
        let _ = spec;
        todo!("map")
    }
    /// Whether anywhere within `radius_m` of `centre` a north-up square of `footprint_m` lies at least `share` on
    /// valid map: the test behind the reason `off_map`. Coarse (a few hundred probes), on the map's mask.
    pub fn can_hold(&mut self, centre: LatLon, radius_m: f64, footprint_m: f64, share: f64) -> Result<bool, MapError> {
        let _ = (centre, radius_m, footprint_m, share);
        todo!("map")
    }
}
