//! Positions on the Earth: WGS84, local ENU metres, geodesic distance, allow-listed EPSG transforms, affines.

mod affine;
mod crs;
mod position;

pub use affine::Affine;
pub use crs::{Crs, GeoError};
pub use position::{Enu, LatLon};
