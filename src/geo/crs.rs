//! Coordinate reference systems: an allow-list of EPSG codes, transformed offline by `proj4rs`.

use super::LatLon;

/// What can go wrong between a coordinate reference system and WGS84.
#[derive(Debug, thiserror::Error)]
pub enum GeoError {
    /// The code is not on the allow-list.
    #[error("EPSG:{code} is not supported: {why}")]
    Unsupported {
        /// EPSG code found.
        code: u32,
        /// Why it is refused.
        why: &'static str,
    },
    /// A coordinate has no image under the transform.
    #[error("EPSG:{code}: {what} ({x}, {y}) cannot be transformed")]
    OutOfRange {
        /// EPSG code.
        code: u32,
        /// Which way, for the reader.
        what: &'static str,
        /// First coordinate.
        x: f64,
        /// Second coordinate.
        y: f64,
    },
}

/// An allow-listed coordinate reference system.
#[derive(Debug, Clone)]
pub struct Crs {
    code: u32,
}

impl Crs {
    /// The system with this EPSG code, if it is on the allow-list.
    pub fn from_epsg(code: u32) -> Result<Self, GeoError> {
        let _ = code;
        todo!("geo")
    }

    /// EPSG code.
    pub fn epsg(&self) -> u32 {
        self.code
    }

    /// WGS84 -> CRS coordinates (metres easting/northing, or degrees lon/lat for geographic systems).
    pub fn forward(&self, at: LatLon) -> Result<(f64, f64), GeoError> {
        let _ = at;
        todo!("geo")
    }

    /// CRS coordinates -> WGS84.
    pub fn inverse(&self, x: f64, y: f64) -> Result<LatLon, GeoError> {
        let _ = (x, y);
        todo!("geo")
    }
}
