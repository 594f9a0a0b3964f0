//! A metric window: a square of the map, resampled to ENU axes about its centre.

use super::MapError;
use crate::geo::{Enu, LatLon};

/// Pixels along a window's side.
const MAX_SIZE_PX: f64 = 8192.0;

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

impl WindowSpec {
    /// Side, pixels: `round(width_m / m_per_px)`, if the window can be made at all.
    pub fn size_px(&self) -> Result<usize, MapError> {
        let Self { centre, width_m, m_per_px } = *self;
        let wrong = |field, expected| Err(MapError::Window { width_m, m_per_px, field, expected });
        if LatLon::new(centre.lat_deg, centre.lon_deg).is_none() {
            return wrong("centre", "a latitude within 90 and a longitude within 180 degrees");
        }
        if !(width_m.is_finite() && m_per_px.is_finite() && width_m > 0.0 && m_per_px > 0.0) {
            return wrong("size", "two positive numbers");
        }
        let size = (width_m / m_per_px).round();
        if (1.0..=MAX_SIZE_PX).contains(&size) { Ok(size as usize) } else { wrong("pixels", "1 to 8192 a side") }
    }

    /// Window pixel -> position: ENU offset from the centre, along the geodesic.
    pub fn to_lat_lon(&self, size_px: usize, x: f64, y: f64) -> LatLon {
        let middle = (size_px as f64 - 1.0) / 2.0;
        self.centre.offset(Enu { east_m: (x - middle) * self.m_per_px, north_m: (middle - y) * self.m_per_px })
    }
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
    /// A pixel is valid where every map pixel that it is made of is.
    pub valid: Vec<u8>,
    /// Window pixel -> map CRS coordinates, the best affine (least squares over the corners and the middle); NaN where the
    /// window lies outside the area of the map's projection.
    pub map_affine: [f64; 6],
}

impl Window {
    /// Share of valid pixels, 0..=1.
    pub fn valid_fraction(&self) -> f64 {
        self.valid.iter().map(|&v| f64::from(v)).sum::<f64>() / self.valid.len().max(1) as f64
    }
    /// Window pixel -> position: ENU offset from the centre, along the geodesic.
    pub fn to_lat_lon(&self, x: f64, y: f64) -> LatLon {
        self.spec.to_lat_lon(self.size_px, x, y)
    }
    /// Position -> window pixel.
    pub fn to_px(&self, at: LatLon) -> (f64, f64) {
        let Enu { east_m, north_m } = self.spec.centre.enu_to(at);
        let middle = (self.size_px as f64 - 1.0) / 2.0;
        (middle + east_m / self.spec.m_per_px, middle - north_m / self.spec.m_per_px)
    }
}
