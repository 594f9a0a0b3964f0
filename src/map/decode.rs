//! Chunks (tiles or strips) of one map, decoded one at a time to packed pixels.

use super::geotiff::GeoTiff;
use super::level::{Colour, Level, Packing};
use super::{MapError, depth::Depth, embedded};
use std::io::BufReader;
use std::panic::{AssertUnwindSafe, catch_unwind};
use tiff::decoder::{Decoder, DecodingResult};

type TiffDecoder = Decoder<BufReader<super::source::PatchedReader>>;

const PHOTOMETRIC: u16 = 262;
/// Alpha from which a pixel counts as map, of 255.
const OPAQUE: u8 = 128;

/// A decoded chunk without its padding. A pixel is `r | g << 8 | b << 16 | v << 24` with v = 255 where the map is valid;
/// invalid pixels are 0.
pub(super) struct Tile {
    pub width: usize,
    pub pixels: Vec<u32>,
}

impl Tile {
    /// Bytes it takes.
    pub fn bytes(&self) -> usize {
        self.pixels.len() * 4 + std::mem::size_of::<Self>()
    }
}

/// Decodes chunks; keeps one `tiff` decoder per resolution.
pub(super) struct ChunkReader {
    decoders: Vec<Option<TiffDecoder>>,
    mask_decoder: Option<((u32, u32), TiffDecoder)>,
    depth: Option<Depth>,
}

impl ChunkReader {
    /// A reader for a map; nothing is decoded yet.
    pub fn new(map: &GeoTiff) -> Self {
        Self { decoders: map.levels().iter().map(|_| None).collect(), mask_decoder: None, depth: None }
    }

    /// Decodes one chunk of a resolution. A chunk that was never written is `None`.
    pub fn tile(&mut self, map: &GeoTiff, level_index: usize, chunk: u32) -> Result<Option<Tile>, MapError> {
        let failed = |found: String| MapError::Decode { path: map.path().to_owned(), level: level_index, chunk, found };
        let Some(level) = map.levels().get(level_index) else { return Err(failed("no such overview".into())) };
        if level.is_sparse(chunk) {
            return Ok(None);
        }
        if level.bits == 16 && self.depth.is_none() {
            self.depth = Some(Depth::observe(map, |l, c| self.samples(map, l, c))?);
        }
        let (width, height) = chunk_size(level, chunk);
        let mut pixels = if is_plain_rgb(level, map.nodata()) {
            let decoder = self.decoder(map, level_index).map_err(failed)?;
            let (raw, row_bytes) = raw_chunk(map, level, decoder, chunk).map_err(failed)?;
            let DecodingResult::U8(bytes) = raw else { return Err(failed("samples that are not bytes".into())) };
            plain_rgb(level, &bytes, row_bytes, width)
        } else {
            let samples = self.samples(map, level_index, chunk)?;
            match &self.depth {
                None => to_pixels(level, map.nodata(), &samples, |s| s as u8),
                Some(depth) => to_pixels(level, map.nodata(), &samples, |s| depth.to_8_bit(s)),
            }
        };
        if pixels.len() != width * height {
            return Err(failed(format!("{} pixels instead of {width} x {height}", pixels.len())));
        }
        if let Some(mask) = map.mask_of(level) {
            self.apply_mask(map, level, mask, chunk, width, &mut pixels).map_err(failed)?;
        }
        Ok(Some(Tile { width, pixels }))
    }

    /// The decoder of a resolution, opened on first use.
    fn decoder(&mut self, map: &GeoTiff, level_index: usize) -> Result<&mut TiffDecoder, String> {
        match (map.levels().get(level_index), self.decoders.get_mut(level_index)) {
            (_, Some(Some(decoder))) => Ok(decoder),
            (Some(level), Some(slot)) => Ok(slot.insert(open_decoder(map, level)?)),
            _ => Err("no such overview".into()),
        }
    }

    /// The samples of a chunk, pixel-interleaved, as the file has them.
    fn samples(&mut self, map: &GeoTiff, level_index: usize, chunk: u32) -> Result<Vec<u16>, MapError> {
        let failed = |found: String| MapError::Decode { path: map.path().to_owned(), level: level_index, chunk, found };
        let decoder = self.decoder(map, level_index).map_err(failed)?;
        let Some(level) = map.levels().get(level_index) else { return Err(failed("no such overview".into())) };
        let (width, height) = chunk_size(level, chunk);
        let planes = if level.planar { level.bands } else { 1 };
        let mut samples = vec![0_u16; width * height * level.bands];
        for plane in 0..planes {
            let index = chunk + plane as u32 * level.chunks_per_plane();
            if level.is_sparse(index) {
                continue;
            }
            let (raw, row_bytes) = raw_chunk(map, level, decoder, index).map_err(failed)?;
            // The crate leaves the last row without its padding.
            let (row, count) = (width * level.bands / planes, width * height * level.bands / planes);
            let slots = samples.iter_mut().skip(plane).step_by(planes);
            let filled = match &raw {
                DecodingResult::U8(bytes) => fill(slots, bytes.chunks(row_bytes), row, |&b| u16::from(b)),
                DecodingResult::U16(words) => fill(slots, words.chunks(row_bytes / 2), row, |&w| w),
                _ => 0,
            };
            if filled != count {
                return Err(failed(format!("{filled} samples instead of {count}")));
            }
        }
        Ok(samples)
    }

    /// Clears the pixels that the mask directory excludes.
    fn apply_mask(
        &mut self,
        map: &GeoTiff,
        level: &Level,
        mask: &Level,
        chunk: u32,
        width: usize,
        pixels: &mut [u32],
    ) -> Result<(), String> {
        let size = (mask.width, mask.height);
        if self.mask_decoder.as_ref().is_none_or(|(open, _)| *open != size) {
            self.mask_decoder = Some((size, open_decoder(map, mask)?));
        }
        let Some((_, decoder)) = &mut self.mask_decoder else { return Ok(()) };
        let (x0, y0) = chunk_origin(level, chunk);
        let (x1, y1) = (x0 + width, y0 + pixels.len() / width.max(1));
        let (mask_w, mask_h) = (mask.chunk_width as usize, mask.chunk_height as usize);
        for row in y0 / mask_h..y1.div_ceil(mask_h) {
            for column in x0 / mask_w..x1.div_ceil(mask_w) {
                let index = (row * mask.across() as usize + column) as u32;
                let (w, h) = chunk_size(mask, index);
                let (raw, row_bytes) = match mask.is_sparse(index) {
                    true => (Vec::new(), 0),
                    false => match raw_chunk(map, mask, decoder, index)? {
                        (DecodingResult::U8(bytes), row_bytes) => (bytes, row_bytes),
                        _ => return Err("a mask that is not of bytes".into()),
                    },
                };
                let valid = |x: usize, y: usize| match mask.bits {
                    1 => raw.get(y * row_bytes + x / 8).is_some_and(|b| b >> (7 - x % 8) & 1 == 1),
                    _ => raw.get(y * row_bytes + x).is_some_and(|&b| b != 0),
                };
                let (left, top) = (column * mask_w, row * mask_h);
                for y in y0.max(top)..y1.min(top + h) {
                    for x in x0.max(left)..x1.min(left + w) {
                        if !valid(x - left, y - top)
                            && let Some(pixel) = pixels.get_mut((y - y0) * width + x - x0)
                        {
                            *pixel = 0;
                        }
                    }
                }
            }
        }
        Ok(())
    }
}

/// Copies the first `row` samples of every row; how many there were.
fn fill<'a, T: 'a>(
    mut slots: impl Iterator<Item = &'a mut u16>,
    rows: impl Iterator<Item = &'a [T]>,
    row: usize,
    convert: impl Fn(&T) -> u16,
) -> usize {
    let mut filled = 0;
    for value in rows.flat_map(|r| r.iter().take(row)) {
        let Some(slot) = slots.next() else { break };
        *slot = convert(value);
        filled += 1;
    }
    filled
}

/// Left and top pixel of a chunk.
pub(super) fn chunk_origin(level: &Level, chunk: u32) -> (usize, usize) {
    let (across, within) = (level.across(), chunk % level.chunks_per_plane());
    ((within % across) as usize * level.chunk_width as usize, (within / across) as usize * level.chunk_height as usize)
}

/// Width and height of a chunk without its padding.
fn chunk_size(level: &Level, chunk: u32) -> (usize, usize) {
    let (x, y) = chunk_origin(level, chunk);
    let width = (level.width as usize).saturating_sub(x).min(level.chunk_width as usize);
    (width, (level.height as usize).saturating_sub(y).min(level.chunk_height as usize))
}

/// A `tiff` decoder that stands at a level's directory.
///
/// It is shown the file with two edits. The first directory is the level's, so that the chain need not be walked. And the
/// colour model is "grey, any number of bands": the crate drops the extra bands of RGB before it undoes the predictor and
/// refuses masks, while we want the samples as they are.
fn open_decoder(map: &GeoTiff, level: &Level) -> Result<TiffDecoder, String> {
    let order = |number: u64, bytes: usize| -> Vec<u8> {
        let big = number.to_be_bytes();
        let tail = big.iter().skip(8 - bytes).copied();
        if map.is_big_endian() { tail.collect() } else { tail.rev().collect() }
    };
    let mut patches = vec![if map.is_big_tiff() { (8, order(level.directory.at, 8)) } else { (4, order(level.directory.at, 4)) }];
    patches.extend(level.directory.short_at(PHOTOMETRIC).map(|at| (at, order(1, 2))));
    guarded(|| Decoder::new(BufReader::new(map.source().reader(patches))).map_err(|e| e.to_string()))
}

/// The decompressed samples of one chunk, predictor undone, padding included, and the bytes of a row.
fn raw_chunk(map: &GeoTiff, level: &Level, decoder: &mut TiffDecoder, chunk: u32) -> Result<(DecodingResult, usize), String> {
    if matches!(level.packing, Packing::Jpeg | Packing::WebP) {
        // These carry a size of their own, which their decoders trust and allocate.
        let &(at, count) = level.chunks.get(chunk as usize).ok_or("no such chunk")?;
        let bytes = map.source().bytes(at, count).ok_or("a chunk outside the file")?;
        let limit = (level.chunk_width, level.chunk_height);
        match level.packing {
            Packing::Jpeg => embedded::check_jpeg(&bytes, limit)?,
            _ => embedded::check_webp(&bytes, limit)?,
        }
    }
    let samples = if level.planar { 1 } else { level.bands };
    let row_bytes = (level.chunk_width as usize * samples * level.bits as usize).div_ceil(8);
    guarded(|| {
        let mut out = DecodingResult::U8(Vec::new());
        // With the padding: without it the crate reads row by row, and its LZW reader then loses the last row of some tiles.
        decoder.read_chunk_to_buffer(&mut out, chunk, row_bytes).map_err(|e| e.to_string())?;
        Ok((out, row_bytes))
    })
}

/// Runs a decoder that is not ours: should it panic on a damaged file, that is an error like any other.
fn guarded<T>(decode: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(decode)).unwrap_or_else(|_| Err("a file on which the decoder gave up".into()))
}

/// Whether a level is what most maps are: three interleaved bytes per pixel, all of them valid.
fn is_plain_rgb(level: &Level, nodata: Option<u32>) -> bool {
    let three_bytes = level.bits == 8 && level.bands == 3 && !level.planar && level.alpha.is_none();
    three_bytes && nodata.is_none() && matches!(level.colour, Colour::Rgb | Colour::YCbCr)
}

/// Pixels of such a level, by the short way.
fn plain_rgb(level: &Level, bytes: &[u8], row_bytes: usize, width: usize) -> Vec<u32> {
    let pixels = bytes.chunks(row_bytes).flat_map(|row| row.as_chunks::<3>().0.iter().take(width));
    match level.colour {
        Colour::YCbCr => pixels.map(|&[y, cb, cr]| opaque(ycbcr_to_rgb(y, cb, cr))).collect(),
        _ => pixels.map(|&rgb| opaque(rgb)).collect(),
    }
}

/// A valid pixel.
fn opaque([r, g, b]: [u8; 3]) -> u32 {
    u32::from_le_bytes([r, g, b, 255])
}

/// Samples of one chunk to packed pixels.
fn to_pixels(level: &Level, nodata: Option<u32>, samples: &[u16], to_8_bit: impl Fn(u16) -> u8) -> Vec<u32> {
    let alpha = level.alpha;
    let colour_bands = alpha.unwrap_or(level.bands).min(level.bands);
    let pixel = |bands: &[u16]| -> u32 {
        let transparent =
            alpha.and_then(|a| bands.get(a)).is_some_and(|&a| (if level.bits == 16 { (a >> 8) as u8 } else { a as u8 }) < OPAQUE);
        let absent = nodata.is_some_and(|n| bands.iter().take(colour_bands).all(|&b| u32::from(b) == n));
        if transparent || absent {
            return 0;
        }
        let byte = |i: usize| bands.get(i).map_or(0, |&b| to_8_bit(b));
        let rgb = match &level.colour {
            Colour::Grey | Colour::Mask => [byte(0); 3],
            Colour::InvertedGrey => [255 - byte(0); 3],
            Colour::Rgb => [byte(0), byte(1), byte(2)],
            Colour::YCbCr => ycbcr_to_rgb(byte(0), byte(1), byte(2)),
            Colour::Palette(colours) => bands.first().and_then(|&i| colours.get(usize::from(i))).copied().unwrap_or_default(),
        };
        opaque(rgb)
    };
    samples.chunks_exact(level.bands).map(pixel).collect()
}

/// Full-range BT.601 in 16-bit fixed point, as libjpeg has it. Reference: JFIF 1.02, section "Conversion to and from RGB".
fn ycbcr_to_rgb(y: u8, cb: u8, cr: u8) -> [u8; 3] {
    let (y, cb, cr) = (i32::from(y), i32::from(cb) - 128, i32::from(cr) - 128);
    let r = y + ((91_881 * cr + 32_768) >> 16);
    let g = y + ((-22_554 * cb - 46_802 * cr + 32_768) >> 16);
    let b = y + ((116_130 * cb + 32_768) >> 16);
    [r, g, b].map(|v| v.clamp(0, 255) as u8)
}
