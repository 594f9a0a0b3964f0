//! The satellite map: GeoTIFF reading (untrusted input), metric windows, cache.

mod cache;
mod error;
mod geotiff;
mod window;

pub use cache::MapCache;
pub use error::MapError;
pub use geotiff::GeoTiff;
pub use window::{Window, WindowSpec};
