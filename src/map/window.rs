//! A metric window: a square of the map, resampled to ENU axes about its centre.

use crate::geo::LatLon;

/// Which window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindowSpec {
    /// The window's middle: the ground point at pixel `((size - 1) / 2, (size - 1) / 2)`.
    pub centre: LatLon,
    /// Side, ground metres.
    pub width_m: f64,
    /// Ground metres per pixel.
    pub m_per_px: f64,
}

/// A window's pixels. x is true east, y is true south, an integer is the centre of a pixel.
#[derive(Debug, Clone)]
pub struct Window {
    /// What was asked for.
    pub spec: WindowSpec,
    /// Side, pixels: `round(width_m / m_per_px)`.
    pub size_px: usize,
    /// Interleaved RGB, row-major, `size_px * size_px * 3` bytes. 0 where there is no map.
    pub rgb: Vec<u8>,
    /// 1 where the map is valid, 0 where it is nodata, transparent or absent; `size_px * size_px` bytes.
    pub valid: Vec<u8>,
    /// Window pixel -> map CRS coordinates, the best affine (least squares over the corners and the middle).
    pub map_affine: [f64; 6],
}

impl Window {
    /// Share of valid pixels, 0..=1.
    pub fn valid_fraction(&self) -> f64 {
        self.valid.iter().map(|&v| f64::from(v)).sum::<f64>() / self.valid.len().max(1) as f64
    }
    /// Window pixel -> position: ENU offset from the centre, along the geodesic.
    pub fn to_lat_lon(&self, x: f64, y: f64) -> LatLon {
        let _ = (x, y);
        todo!("map")
    }
    /// Position -> window pixel.
    pub fn to_px(&self, at: LatLon) -> (f64, f64) {
        let _ = at;
        todo!("map")
    }
}
