//! A georeferenced TIFF, opened once and read tile by tile.

use super::MapError;
use crate::geo::{Affine, Crs, LatLon};
use std::path::Path;

/// An open GeoTIFF.
pub struct GeoTiff {}

impl GeoTiff {
    /// Opens a map, reads and checks its header. No pixel is decoded.
    pub fn open(path: &Path) -> Result<Self, MapError> {
        let _ = path;
        todo!("map")
    }
    /// File name without its folder.
    pub fn name(&self) -> &str {
        todo!("map")
    }
    /// SHA-256 of the whole file, lower-case hex (streamed; computed on first use).
    pub fn digest(&self) -> Result<String, MapError> {
        todo!("map")
    }
    /// Width and height of the full-resolution image, pixels.
    pub fn size_px(&self) -> (u32, u32) {
        todo!("map")
    }
    /// Its coordinate reference system.
    pub fn crs(&self) -> &Crs {
        todo!("map")
    }
    /// Full-resolution pixel (integer = centre of a pixel) -> CRS coordinates.
    pub fn affine(&self) -> &Affine {
        todo!("map")
    }
    /// The middle of the image.
    pub fn centre(&self) -> Result<LatLon, MapError> {
        todo!("map")
    }
    /// Ground metres per pixel at the middle (geometric mean of both axes).
    pub fn m_per_px(&self) -> f64 {
        todo!("map")
    }
}
