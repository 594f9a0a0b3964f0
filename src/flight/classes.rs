//! Land-cover maps (`*_classes.tif`): one byte a pixel, on the same grid as the map they belong to.

use crate::geo::{Affine, Crs};
use std::io::BufWriter;
use std::path::Path;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::encoder::{Compression, DeflateLevel, TiffEncoder, colortype::Gray8};
use tiff::tags::Tag;

/// Largest land-cover map, pixels.
const MAX_PX: u64 = 1 << 29;

/// Reads a land-cover map that must have the size of its map. Returns row-major codes.
///
/// # Errors
/// In words, naming expected and found: not a TIFF, another size, not one band of bytes.
pub fn read(path: &Path, size_px: (u32, u32)) -> Result<Vec<u8>, String> {
    let file = std::fs::File::open(path).map_err(|e| e.to_string())?;
    let mut decoder = Decoder::new(std::io::BufReader::new(file)).map_err(|e| e.to_string())?;
    let found = decoder.dimensions().map_err(|e| e.to_string())?;
    if found != size_px || u64::from(found.0) * u64::from(found.1) > MAX_PX {
        return Err(format!("size: expected {} x {} px like its map, found {} x {}", size_px.0, size_px.1, found.0, found.1));
    }
    let mut limits = Limits::default();
    limits.decoding_buffer_size = found.0 as usize * found.1 as usize + 1;
    decoder = decoder.with_limits(limits);
    match decoder.colortype().map_err(|e| e.to_string())? {
        tiff::ColorType::Gray(8) => {}
        other => return Err(format!("pixels: expected one band of 8 bits, found {other:?}")),
    }
    match decoder.read_image().map_err(|e| e.to_string())? {
        DecodingResult::U8(codes) if codes.len() == found.0 as usize * found.1 as usize => Ok(codes),
        _ => Err("pixels: expected one band of 8 bits, found another layout".into()),
    }
}

/// Writes a land-cover map as a GeoTIFF: strips, DEFLATE, PixelIsArea. `affine` takes pixel centres to `crs`, which must
/// be a projected system.
pub fn write(path: &Path, codes: &[u8], width: u32, height: u32, affine: &Affine, crs: &Crs) -> Result<(), String> {
    let file = std::fs::File::create(path).map_err(|e| e.to_string())?;
    let text = |e: tiff::TiffError| e.to_string();
    let mut encoder =
        TiffEncoder::new(BufWriter::new(file)).map_err(text)?.with_compression(Compression::Deflate(DeflateLevel::Balanced));
    let mut image = encoder.new_image::<Gray8>(width, height).map_err(text)?;
    let ([a, _, _, _, e, _], (c, f)) = (affine.0, affine.apply(-0.5, -0.5));
    let directory = image.encoder();
    directory.write_tag(Tag::ModelPixelScaleTag, &[a, -e, 0.0][..]).map_err(text)?;
    directory.write_tag(Tag::ModelTiepointTag, &[0.0, 0.0, 0.0, c, f, 0.0][..]).map_err(text)?;
    // GTModelType projected, GTRasterType area, ProjectedCSType.
    let code = u16::try_from(crs.epsg()).map_err(|_| format!("EPSG:{} does not fit a geokey", crs.epsg()))?;
    let keys = [1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, code];
    directory.write_tag(Tag::GeoKeyDirectoryTag, &keys[..]).map_err(text)?;
    image.write_data(codes).map_err(text)
}
