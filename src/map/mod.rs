//! The satellite map: GeoTIFF reading (untrusted input), metric windows, cache.
//!
//! Doors: [`GeoTiff`] (header and georeference), [`MapCache`] (windows of pixels), [`write_rgb`], [`write_bands`] (maps of our own).
//! Inside, in the order of a pixel's way: `source` (bytes) -> `ifd` (directories) -> `level` + `geokeys` (layout and place) ->
//! `decode` (chunks, with `depth` and `embedded`) -> `tiles` (kept chunks) -> `lattice` (window px -> map px) ->
//! `resample` + `block` (window pixels). `coverage` answers where the map is valid without making a window.

mod block;
mod cache;
mod coverage;
mod decode;
mod depth;
mod embedded;
mod error;
mod geokeys;
mod geotiff;
mod ifd;
mod lattice;
mod level;
mod resample;
mod source;
mod tiles;
mod window;
mod write;

pub use cache::MapCache;
pub use error::MapError;
pub use geotiff::GeoTiff;
pub use window::{Window, WindowSpec};
pub use write::{write_bands, write_rgb};
