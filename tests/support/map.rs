//! A small GeoTIFF with a landscape on it, in UTM zone 40 (grid north is not true north there).

use super::bundle::Landscape;
use nightfix::geo::{Crs, LatLon};
use std::path::Path;
use tiff::encoder::{TiffEncoder, colortype::RGB8};
use tiff::tags::Tag;

pub const MAP_PX: usize = 720;
const EPSG: u16 = 32640;
const ORIGIN: [f64; 2] = [322_400.0, 2_789_300.0];

/// Writes it; black (nodata 0) where `absent` says so.
pub fn write(path: &Path, land: &Landscape, absent: impl Fn(usize, usize) -> bool) {
    write_levels(path, |x, y| if absent(x, y) { 0 } else { land.level(x as f64, y as f64).max(1) });
}

/// Writes one of any brightness; 0 is nodata.
pub fn write_levels(path: &Path, level: impl Fn(usize, usize) -> u8) {
    let pixels: Vec<u8> = (0..MAP_PX * MAP_PX).flat_map(|i| [level(i % MAP_PX, i / MAP_PX); 3]).collect();
    let mut encoder = TiffEncoder::new(std::fs::File::create(path).unwrap()).unwrap();
    let mut image = encoder.new_image::<RGB8>(MAP_PX as u32, MAP_PX as u32).unwrap();
    let tags = image.encoder();
    tags.write_tag(Tag::ModelPixelScaleTag, &[1.0, 1.0, 0.0][..]).unwrap();
    tags.write_tag(Tag::ModelTiepointTag, &[0.0, 0.0, 0.0, ORIGIN[0], ORIGIN[1], 0.0][..]).unwrap();
    // GTModelTypeGeoKey projected, GTRasterTypeGeoKey PixelIsArea, ProjectedCSTypeGeoKey.
    let keys: [u16; 16] = [1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, EPSG];
    tags.write_tag(Tag::GeoKeyDirectoryTag, &keys[..]).unwrap();
    tags.write_tag(Tag::GdalNodata, "0").unwrap();
    image.write_data(&pixels).unwrap();
}

/// Its coordinate system.
pub fn crs() -> Crs {
    Crs::from_epsg(u32::from(EPSG)).unwrap()
}

/// The position of a map pixel's centre.
pub fn position(x: f64, y: f64) -> LatLon {
    crs().inverse(ORIGIN[0] + x + 0.5, ORIGIN[1] - y - 0.5).unwrap()
}
