//! Maps of our own: GeoTIFFs in tiles, DEFLATE, that GDAL and QGIS read. RGB for procedural worlds, bands of 32-bit floats
//! for surveys.

use super::MapError;
use crate::geo::{Affine, Crs};
use std::io::Write;
use std::path::Path;
use tiff::encoder::compression::{CompressionAlgorithm, Deflate};

/// Side of a tile, pixels.
const TILE: usize = 256;
const DEFLATE: u16 = 8;
const HEADER_BYTES: u32 = 8;

/// Writes an 8-bit RGB GeoTIFF.
///
/// `rgb` is interleaved, row-major, `width * height * 3` bytes. `affine` takes a pixel (integer = centre) to coordinates of
/// `crs`, as [`super::GeoTiff::affine`] gives it back. The file is a classic TIFF of less than 4 GiB, PixelIsArea.
pub fn write_rgb(path: &Path, rgb: &[u8], width: usize, height: usize, affine: &Affine, crs: &Crs) -> Result<(), MapError> {
    write_tiles(path, rgb, &Layout::Rgb, (width, height), affine, crs)
}

/// Writes a GeoTIFF of named bands, 32-bit floats; NaN is nodata. Every band is row-major, `width * height` numbers; else
/// as [`write_rgb`].
pub fn write_bands(
    path: &Path,
    bands: &[(&str, &[f32])],
    width: usize,
    height: usize,
    affine: &Affine,
    crs: &Crs,
) -> Result<(), MapError> {
    let count = width.saturating_mul(height);
    if let Some((name, band)) = bands.iter().find(|(_, band)| band.len() != count) {
        return Err(MapError::Format {
            path: path.to_owned(),
            field: "band",
            expected: format!("{width} x {height} numbers"),
            found: format!("`{name}` of {}", band.len()),
        });
    }
    let pixels = (0..count).flat_map(|i| bands.iter().filter_map(move |(_, band)| band.get(i)));
    let bytes: Vec<u8> = pixels.flat_map(|value| value.to_le_bytes()).collect();
    let names = bands.iter().map(|(name, _)| (*name).to_owned()).collect();
    write_tiles(path, &bytes, &Layout::Floats(names), (width, height), affine, crs)
}

/// What a pixel is.
enum Layout {
    /// Three bytes.
    Rgb,
    /// A 32-bit float for each name.
    Floats(Vec<String>),
}

impl Layout {
    fn bytes(&self) -> usize {
        match self {
            Self::Rgb => 3,
            Self::Floats(names) => 4 * names.len(),
        }
    }
}

fn write_tiles(
    path: &Path,
    pixels: &[u8],
    layout: &Layout,
    (width, height): (usize, usize),
    affine: &Affine,
    crs: &Crs,
) -> Result<(), MapError> {
    let io = |source| MapError::Io { path: path.to_owned(), source };
    let format = |field, expected: String, found: String| MapError::Format { path: path.to_owned(), field, expected, found };
    let bytes = layout.bytes();
    if pixels.is_empty() || width.checked_mul(height).and_then(|n| n.checked_mul(bytes)) != Some(pixels.len()) {
        return Err(format(
            "pixels",
            format!("{width} x {height} x {bytes} bytes, at least one pixel"),
            format!("{} bytes", pixels.len()),
        ));
    }
    if affine.inverse().is_none() || affine.0.iter().any(|v| !v.is_finite()) {
        return Err(format("pixel transform", "six finite numbers that can be inverted".into(), format!("{:?}", affine.0)));
    }
    let too_large = || format("size", "less than 4 GiB compressed".into(), format!("{width} x {height} px"));

    let mut file = std::io::BufWriter::new(std::fs::File::create(path).map_err(io)?);
    // The directory's offset is known, and written, last.
    file.write_all(b"II\x2a\0\0\0\0\0").map_err(io)?;
    let mut at = HEADER_BYTES;
    let (mut offsets, mut counts) = (Vec::new(), Vec::new());
    let (mut tile, mut packed) = (vec![0; TILE * TILE * bytes], Vec::new());
    for top in (0..height).step_by(TILE) {
        for left in (0..width).step_by(TILE) {
            tile.fill(0);
            let columns = TILE.min(width - left);
            for (row, line) in tile.chunks_exact_mut(TILE * bytes).take(height - top).enumerate() {
                let start = ((top + row) * width + left) * bytes;
                if let (Some(to), Some(from)) = (line.get_mut(..columns * bytes), pixels.get(start..start + columns * bytes)) {
                    to.copy_from_slice(from);
                }
            }
            packed.clear();
            Deflate::default().write_to(&mut packed, &tile).map_err(io)?;
            file.write_all(&packed).map_err(io)?;
            let count = u32::try_from(packed.len()).map_err(|_| too_large())?;
            offsets.push(at);
            counts.push(count);
            at = at.checked_add(count).ok_or_else(too_large)?;
        }
    }
    if at % 2 == 1 {
        file.write_all(&[0]).map_err(io)?;
        at += 1;
    }
    let directory = Directory::new(layout, (width, height), (&offsets, &counts), affine, crs);
    let bytes = directory.bytes(at).ok_or_else(too_large)?;
    file.write_all(&bytes).map_err(io)?;
    let mut file = file.into_inner().map_err(|e| io(e.into_error()))?;
    std::io::Seek::seek(&mut file, std::io::SeekFrom::Start(4)).map_err(io)?;
    file.write_all(&at.to_le_bytes()).map_err(io)?;
    file.sync_all().map_err(io)
}

/// Tags in ascending order: number, type, count, little-endian values.
struct Directory(Vec<(u16, u16, usize, Vec<u8>)>);

impl Directory {
    fn new(
        layout: &Layout,
        (width, height): (usize, usize),
        (offsets, counts): (&[u32], &[u32]),
        affine: &Affine,
        crs: &Crs,
    ) -> Self {
        let short = |tag: u16, values: &[u16]| (tag, 3, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect());
        let long = |tag: u16, values: &[u32]| (tag, 4, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect());
        let double = |tag: u16, values: &[f64]| (tag, 12, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect());
        let ascii = |tag: u16, text: String| {
            let mut text = text.into_bytes();
            text.push(0);
            (tag, 2, text.len(), text)
        };
        let (bits, samples) = match layout {
            Layout::Rgb => (8, 3),
            Layout::Floats(names) => (32, names.len()),
        };
        let photometric = if matches!(layout, Layout::Rgb) { 2 } else { 1 };
        let mut tags = vec![
            long(256, &[width as u32]),
            long(257, &[height as u32]),
            short(258, &vec![bits; samples]),
            short(259, &[DEFLATE]),
            short(262, &[photometric]), // RGB, or black is zero
            short(277, &[samples as u16]),
            short(284, &[1]), // chunky
            short(322, &[TILE as u16]),
            short(323, &[TILE as u16]),
            long(324, offsets),
            long(325, counts),
        ];
        if matches!(layout, Layout::Floats(_)) {
            if samples > 1 {
                tags.push(short(338, &vec![0; samples - 1])); // no colours
            }
            tags.push(short(339, &vec![3; samples])); // IEEE floats
        }
        // Raster space has its integers at corners: half a pixel before the centre.
        let [a, b, _, d, e, _] = affine.0;
        let (c, f) = affine.apply(-0.5, -0.5);
        if b == 0.0 && d == 0.0 && a > 0.0 && e < 0.0 {
            tags.push(double(33550, &[a, -e, 0.0]));
            tags.push(double(33922, &[0.0, 0.0, 0.0, c, f, 0.0]));
        } else {
            tags.push(double(34264, &[a, b, 0.0, c, d, e, 0.0, f, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]));
        }
        // GTModelType, GTRasterType = area, the code. Allow-listed codes fit 16 bits.
        let (model, key) = if crs.is_geographic() { (2, 2048) } else { (1, 3072) };
        tags.push(short(34735, &[1, 1, 0, 3, 1024, 0, 1, model, 1025, 0, 1, 1, key, 0, 1, crs.epsg() as u16]));
        if let Layout::Floats(names) = layout {
            let items = names
                .iter()
                .enumerate()
                .map(|(i, name)| format!("<Item name=\"DESCRIPTION\" sample=\"{i}\" role=\"description\">{name}</Item>"));
            tags.push(ascii(42112, format!("<GDALMetadata>{}</GDALMetadata>", items.collect::<String>())));
            tags.push(ascii(42113, "nan".to_owned()));
        }
        Self(tags)
    }

    /// The directory as it stands at offset `at`, its long values behind it.
    fn bytes(&self, at: u32) -> Option<Vec<u8>> {
        let mut out = u16::try_from(self.0.len()).ok()?.to_le_bytes().to_vec();
        let mut behind = Vec::new();
        let body = at.checked_add(u32::try_from(2 + self.0.len() * 12 + 4).ok()?)?;
        for (tag, kind, count, values) in &self.0 {
            out.extend(tag.to_le_bytes());
            out.extend(kind.to_le_bytes());
            out.extend(u32::try_from(*count).ok()?.to_le_bytes());
            if values.len() <= 4 {
                let mut inline = values.clone();
                inline.resize(4, 0);
                out.extend(inline);
            } else {
                out.extend(body.checked_add(u32::try_from(behind.len()).ok()?)?.to_le_bytes());
                behind.extend(values);
                if behind.len() % 2 == 1 {
                    behind.push(0);
                }
            }
        }
        out.extend([0; 4]);
        out.extend(behind);
        Some(out)
    }
}
