//! Coordinate reference systems: an allow-list of EPSG codes, transformed offline by `proj4rs`.
//!
//! A map in the wrong datum is tens to hundreds of metres off and looks perfect, so a code is accepted only where this
//! implementation agrees with PROJ to a millimetre (`tests/geo_crs.rs` checks every family against pyproj). Systems that
//! need a datum-shift grid are refused with the reason.

use super::LatLon;
use proj4rs::{Proj, transform::transform};
use std::sync::Arc;

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

/// Linear or angular unit of a system's axes, as its EPSG code (what GeoTIFF keys name).
pub(crate) const UNIT_METRE: u32 = 9001;
pub(crate) const UNIT_US_SURVEY_FOOT: u32 = 9003;
pub(crate) const UNIT_DEGREE: u32 = 9102;

const DATUM_GRID: &str =
    "its datum needs a shift grid that is not carried; reproject the map to WGS84 (gdalwarp -t_srs EPSG:4326, or a UTM zone)";
const INEXACT: &str =
    "it cannot be transformed to better than a metre here; reproject the map to WGS84 (gdalwarp -t_srs EPSG:4326, or a UTM zone)";
const NOT_HORIZONTAL: &str = "it is not a horizontal system";
const USER_DEFINED: &str =
    "user-defined systems carry no code to look up; assign or reproject to an EPSG system (gdalwarp -t_srs EPSG:4326)";
const UNKNOWN: &str =
    "it is not on the list of systems checked to be exact; reproject the map to WGS84 (gdalwarp -t_srs EPSG:4326, or a UTM zone)";

/// An allow-listed coordinate reference system.
#[derive(Clone)]
pub struct Crs {
    code: u32,
    unit: u32,
    /// `None` for WGS84 longitude/latitude itself (and datums taken as equal to it).
    projection: Option<Arc<Projection>>,
}

/// A projection and the WGS84 system it is reached from.
struct Projection {
    projected: Proj,
    wgs84: Proj,
}

impl std::fmt::Debug for Crs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Crs(EPSG:{})", self.code)
    }
}

/// Geographic systems whose datum agrees with WGS84 within the error of a satellite map (ETRS89, NAD83, SIRGAS, CGCS2000...).
fn is_geographic(code: u32) -> bool {
    matches!(code, 4326 | 4258 | 4269 | 4490 | 4674 | 4167)
}

/// Projected systems checked against PROJ: the unit of their axes.
fn projected_unit(code: u32) -> Option<u32> {
    let metre = matches!(code,
        3857 | 3395                                 // Web Mercator, World Mercator
        | 32601..=32660 | 32701..=32760             // WGS84 / UTM
        | 32661 | 32761 | 5041 | 5042               // UPS
        | 25828..=25838 | 3035 | 3034               // ETRS89: UTM, LAEA and LCC Europe
        | 26910..=26923                             // NAD83 / UTM; further west PROJ shifts the datum
        | 31978..=31985                             // SIRGAS 2000 / UTM south
        | 2154 | 2180 | 2193 | 5179 | 6372          // France, Poland, New Zealand, Korea, Mexico
        | 3031 | 3413 | 3976 | 3995 | 5070          // polar stereographic, CONUS Albers
    );
    match code {
        _ if metre => Some(UNIT_METRE),
        2263 => Some(UNIT_US_SURVEY_FOOT), // NAD83 / New York Long Island
        _ => None,
    }
}

/// Why a code is refused.
fn refusal(code: u32) -> &'static str {
    match code {
        // Great Britain, Netherlands, Belgium, Germany, ED50, NAD27, Australia 1994, Japan (old): grids.
        27700 | 28991 | 28992 | 31370 | 31466..=31469 | 23028..=23038 | 26701..=26722 | 4267 | 4230 | 4277 => DATUM_GRID,
        // Krovak, Israel, Lebanon: 10 to 125 m off.
        5513 | 5514 | 2039 | 22770 => INEXACT,
        4978 | 4979 => NOT_HORIZONTAL,
        32767 => USER_DEFINED,
        _ => UNKNOWN,
    }
}

impl Crs {
    /// The system with this EPSG code, if it is on the allow-list.
    pub fn from_epsg(code: u32) -> Result<Self, GeoError> {
        let unsupported = |why| GeoError::Unsupported { code, why };
        if is_geographic(code) {
            return Ok(Self { code, unit: UNIT_DEGREE, projection: None });
        }
        let unit = projected_unit(code).ok_or_else(|| unsupported(refusal(code)))?;
        let short = u16::try_from(code).map_err(|_| unsupported(UNKNOWN))?;
        let projected = Proj::from_epsg_code(short).map_err(|_| unsupported(INEXACT))?;
        let wgs84 = Proj::from_epsg_code(4326).map_err(|_| unsupported(INEXACT))?;
        Ok(Self { code, unit, projection: Some(Arc::new(Projection { projected, wgs84 })) })
    }

    /// EPSG code.
    pub fn epsg(&self) -> u32 {
        self.code
    }

    /// Whether coordinates are longitude and latitude in degrees.
    pub fn is_geographic(&self) -> bool {
        self.projection.is_none()
    }

    /// EPSG code of the axes' unit: 9001 metre, 9003 US survey foot, 9102 degree.
    pub fn unit_epsg(&self) -> u32 {
        self.unit
    }

    /// After how many units the first coordinate repeats (a turn around the Earth), where it does.
    pub fn wrap(&self) -> Option<f64> {
        match self.code {
            3857 | 3395 => Some(std::f64::consts::TAU * 6_378_137.0),
            _ if self.is_geographic() => Some(360.0),
            _ => None,
        }
    }

    /// WGS84 -> CRS coordinates (metres easting/northing, or degrees lon/lat for geographic systems).
    ///
    /// Far outside a projection's area the result may be wrong without an error: see [`Crs::forward_checked`].
    pub fn forward(&self, at: LatLon) -> Result<(f64, f64), GeoError> {
        let LatLon { lat_deg, lon_deg } = at;
        let out_of_range = || GeoError::OutOfRange { code: self.code, what: "longitude/latitude", x: lon_deg, y: lat_deg };
        if !lon_deg.is_finite() || !(-90.0..=90.0).contains(&lat_deg) {
            return Err(out_of_range());
        }
        let Some(p) = &self.projection else { return Ok((lon_deg, lat_deg)) };
        let mut point = (lon_deg.to_radians(), lat_deg.to_radians(), 0.0);
        transform(&p.wgs84, &p.projected, &mut point).map_err(|_| out_of_range())?;
        if point.0.is_finite() && point.1.is_finite() { Ok((point.0, point.1)) } else { Err(out_of_range()) }
    }

    /// As [`Crs::forward`], and the way back must return within a metre: the guard against a projection used half a world
    /// from where it is defined.
    pub fn forward_checked(&self, at: LatLon) -> Result<(f64, f64), GeoError> {
        let (x, y) = self.forward(at)?;
        let back = self.inverse(x, y)?;
        if back.distance_m(at) < 1.0 {
            Ok((x, y))
        } else {
            Err(GeoError::OutOfRange { code: self.code, what: "longitude/latitude", x: at.lon_deg, y: at.lat_deg })
        }
    }

    /// CRS coordinates -> WGS84.
    pub fn inverse(&self, x: f64, y: f64) -> Result<LatLon, GeoError> {
        let out_of_range = || GeoError::OutOfRange { code: self.code, what: "coordinates", x, y };
        if !x.is_finite() || !y.is_finite() {
            return Err(out_of_range());
        }
        let (lon_deg, lat_deg) = match &self.projection {
            None => (x, y),
            Some(p) => {
                let mut point = (x, y, 0.0);
                transform(&p.projected, &p.wgs84, &mut point).map_err(|_| out_of_range())?;
                (point.0.to_degrees(), point.1.to_degrees())
            }
        };
        if !lon_deg.is_finite() || lon_deg.abs() > 540.0 {
            return Err(out_of_range());
        }
        // Maps that cross the antimeridian run past 180 degrees.
        let lon_deg = if lon_deg.abs() > 180.0 { lon_deg - 360.0 * (lon_deg / 360.0).round() } else { lon_deg };
        LatLon::new(lat_deg, lon_deg).ok_or_else(out_of_range)
    }
}
