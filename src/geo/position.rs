//! WGS84 positions and local metric offsets.

use geographiclib_rs::{DirectGeodesic, Geodesic, InverseGeodesic};
use serde::{Deserialize, Serialize};

/// A WGS84 position, in degrees.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LatLon {
    /// Geodetic latitude, degrees, -90..=90.
    pub lat_deg: f64,
    /// Longitude, degrees, -180..=180.
    pub lon_deg: f64,
}

/// An offset in local east-north axes: true north, ground metres on the ellipsoid.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Enu {
    /// Metres towards true east.
    pub east_m: f64,
    /// Metres towards true north.
    pub north_m: f64,
}

impl LatLon {
    /// A position, if both numbers are finite and in range.
    pub fn new(lat_deg: f64, lon_deg: f64) -> Option<Self> {
        let valid = (-90.0..=90.0).contains(&lat_deg) && (-180.0..=180.0).contains(&lon_deg);
        valid.then_some(Self { lat_deg, lon_deg })
    }

    /// Geodesic distance on the WGS84 ellipsoid, metres. Reference: Karney, J. Geodesy 87, 2013.
    pub fn distance_m(self, other: Self) -> f64 {
        Geodesic::wgs84().inverse(self.lat_deg, self.lon_deg, other.lat_deg, other.lon_deg)
    }

    /// The position at an offset: the geodesic that leaves `self` in that direction, as long as the offset is.
    pub fn offset(self, by: Enu) -> Self {
        let azimuth_deg = by.east_m.atan2(by.north_m).to_degrees();
        let length_m = by.east_m.hypot(by.north_m);
        let (lat_deg, lon_deg) = Geodesic::wgs84().direct(self.lat_deg, self.lon_deg, azimuth_deg, length_m);
        Self { lat_deg, lon_deg }
    }

    /// The offset of `other` as seen from `self`: the inverse of [`LatLon::offset`].
    pub fn enu_to(self, other: Self) -> Enu {
        let (length_m, azimuth_deg, _, _): (f64, f64, f64, f64) =
            Geodesic::wgs84().inverse(self.lat_deg, self.lon_deg, other.lat_deg, other.lon_deg);
        let (sin, cos) = azimuth_deg.to_radians().sin_cos();
        Enu { east_m: length_m * sin, north_m: length_m * cos }
    }
}
