//! Where the pixels lie: GeoKeys and the model transform. Reference: OGC GeoTIFF 1.1 (19-008r4), sections 7 and B.6.

use super::ifd::{Directory, Flaw, Structure, flaw};
use super::source::Source;
use crate::geo::{Affine, Crs};

const PIXEL_SCALE: (u16, &str) = (33550, "ModelPixelScale");
const TIEPOINT: (u16, &str) = (33922, "ModelTiepoint");
const TRANSFORMATION: (u16, &str) = (34264, "ModelTransformation");
const GEO_KEYS: (u16, &str) = (34735, "GeoKeyDirectory");

const KEY_MODEL_TYPE: u64 = 1024;
const KEY_RASTER_TYPE: u64 = 1025;
const KEY_GEOGRAPHIC: u64 = 2048;
const KEY_ANGULAR_UNITS: u64 = 2054;
const KEY_PROJECTED: u64 = 3072;
const KEY_LINEAR_UNITS: u64 = 3076;
/// GeoTIFF's own number for "described by the other keys".
const USER_DEFINED: u32 = 32767;

/// A system and the transform to it.
pub(super) struct Georeference {
    pub crs: Crs,
    /// Pixel (integer = centre) -> CRS coordinates.
    pub affine: Affine,
}

impl Georeference {
    /// Reads the georeference of the full-resolution image.
    pub fn read(file: &Structure, source: &Source, directory: &Directory) -> Result<Self, Flaw> {
        let keys = Keys::read(file, source, directory)?;
        let crs = keys.crs()?;
        let corner = read_affine(file, source, directory)?;
        // The transform of the file maps raster space, where integers are corners (PixelIsArea) or centres (PixelIsPoint).
        let half = match keys.short(KEY_RASTER_TYPE) {
            Some(2) => 0.0,
            None | Some(0 | 1 | USER_DEFINED) => 0.5,
            Some(other) => return Err(flaw("GTRasterType", "1 (area) or 2 (point)", other)),
        };
        let [a, b, _, d, e, _] = corner.0;
        let (c, f) = corner.apply(half, half);
        let affine = Affine([a, b, c, d, e, f]);
        if affine.0.iter().any(|v| !v.is_finite()) || affine.inverse().is_none() {
            return Err(flaw("pixel transform", "six finite numbers that can be inverted", format!("{:?}", affine.0)));
        }
        Ok(Self { crs, affine })
    }
}

/// The GeoKeys that hold a SHORT of their own.
struct Keys(Vec<(u64, u32)>);

impl Keys {
    fn read(file: &Structure, source: &Source, directory: &Directory) -> Result<Self, Flaw> {
        let missing = || flaw(GEO_KEYS.1, "a coordinate reference system", "none; assign one (gdal_edit.py -a_srs EPSG:...)");
        let values = file.unsigned(source, directory, GEO_KEYS)?.ok_or_else(missing)?;
        let mut quads = values.chunks_exact(4);
        let count = match quads.next() {
            Some(&[1, _, _, count]) => count,
            other => return Err(flaw(GEO_KEYS.1, "version 1 and a count", format!("{other:?}"))),
        };
        let keys: Vec<_> = quads
            .take(usize::try_from(count).unwrap_or(usize::MAX))
            .filter_map(|q| match q {
                &[key, 0, _, value] => Some((key, value as u32)),
                _ => None,
            })
            .collect();
        Ok(Self(keys))
    }

    fn short(&self, key: u64) -> Option<u32> {
        self.0.iter().find(|(k, _)| *k == key).map(|(_, v)| *v)
    }

    fn crs(&self) -> Result<Crs, Flaw> {
        let (field, code) = match self.short(KEY_MODEL_TYPE) {
            Some(1) => ("ProjectedCRS", self.short(KEY_PROJECTED)),
            Some(2) => ("GeodeticCRS", self.short(KEY_GEOGRAPHIC)),
            // Some writers leave the model type out: the code that is there says what it is.
            None if self.short(KEY_PROJECTED).is_some() => ("ProjectedCRS", self.short(KEY_PROJECTED)),
            None if self.short(KEY_GEOGRAPHIC).is_some() => ("GeodeticCRS", self.short(KEY_GEOGRAPHIC)),
            None => {
                return Err(flaw(
                    "GTModelType",
                    "1 (projected) or 2 (geographic)",
                    "none: the map has no coordinate reference system",
                ));
            }
            Some(other) => return Err(flaw("GTModelType", "1 (projected) or 2 (geographic)", other)),
        };
        let code = code.ok_or_else(|| flaw(field, "an EPSG code", "none"))?;
        let crs = Crs::from_epsg(code).map_err(|e| flaw(field, "a supported EPSG code", e))?;
        let unit_key = if crs.is_geographic() { KEY_ANGULAR_UNITS } else { KEY_LINEAR_UNITS };
        // A unit that contradicts the code: whose word counts is a guess, so neither does.
        match self.short(unit_key) {
            Some(unit) if unit != crs.unit_epsg() => {
                Err(flaw("unit GeoKey", format!("EPSG:{} as EPSG:{code} has it", crs.unit_epsg()), format!("EPSG:{unit}")))
            }
            _ => Ok(crs),
        }
    }
}

/// Raster space -> CRS coordinates, as the file has it.
fn read_affine(file: &Structure, source: &Source, directory: &Directory) -> Result<Affine, Flaw> {
    if let Some(m) = file.doubles(source, directory, TRANSFORMATION)? {
        return match m.as_slice() {
            &[a, b, _, c, d, e, _, f, ..] if m.len() == 16 => Ok(Affine([a, b, c, d, e, f])),
            _ => Err(flaw(TRANSFORMATION.1, "16 numbers", m.len())),
        };
    }
    let scale = file.doubles(source, directory, PIXEL_SCALE)?;
    let tie = file.doubles(source, directory, TIEPOINT)?;
    match (scale.as_deref(), tie.as_deref()) {
        (Some(&[sx, sy, ..]), Some(&[i, j, _, x, y, ..])) => {
            if !(sx.is_finite() && sy.is_finite() && sx > 0.0 && sy > 0.0) {
                return Err(flaw(PIXEL_SCALE.1, "two positive numbers", format!("{sx} x {sy}")));
            }
            Ok(Affine([sx, 0.0, x - i * sx, 0.0, -sy, y + j * sy]))
        }
        (None, Some(t)) if t.len() > 6 => Err(flaw(
            PIXEL_SCALE.1,
            "a pixel scale or a transformation",
            format!("{} ground control points; warp the map first (gdalwarp)", t.len() / 6),
        )),
        (None, None) => Err(flaw("georeference", "ModelPixelScale and ModelTiepoint, or ModelTransformation", "none")),
        (scale, tie) => Err(flaw(
            "georeference",
            "2 or more scales and 6 tie point numbers",
            format!("{} and {}", scale.map_or(0, <[f64]>::len), tie.map_or(0, <[f64]>::len)),
        )),
    }
}
