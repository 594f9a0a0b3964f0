//! One resolution of a map: the full image or an overview, its layout checked.

use super::embedded;
use super::ifd::{Directory, Flaw, MAX_VALUES, Structure, flaw};
use super::source::Source;

/// Bytes a decoded tile or strip may take: beyond, the map must be re-tiled.
const MAX_CHUNK_BYTES: u64 = 128 << 20;
/// Pixels along one side of an image.
const MAX_SIDE: u64 = 1 << 24;
/// Bands a map may have.
const MAX_BANDS: u64 = 64;

const WIDTH: (u16, &str) = (256, "ImageWidth");
const LENGTH: (u16, &str) = (257, "ImageLength");
const BITS: (u16, &str) = (258, "BitsPerSample");
const COMPRESSION: (u16, &str) = (259, "Compression");
const PHOTOMETRIC: (u16, &str) = (262, "PhotometricInterpretation");
const STRIP_OFFSETS: (u16, &str) = (273, "StripOffsets");
const SAMPLES: (u16, &str) = (277, "SamplesPerPixel");
const ROWS_PER_STRIP: (u16, &str) = (278, "RowsPerStrip");
const STRIP_BYTES: (u16, &str) = (279, "StripByteCounts");
const PLANAR: (u16, &str) = (284, "PlanarConfiguration");
const PREDICTOR: (u16, &str) = (317, "Predictor");
const COLOR_MAP: (u16, &str) = (320, "ColorMap");
const TILE_WIDTH: (u16, &str) = (322, "TileWidth");
const TILE_LENGTH: (u16, &str) = (323, "TileLength");
const TILE_OFFSETS: (u16, &str) = (324, "TileOffsets");
const TILE_BYTES: (u16, &str) = (325, "TileByteCounts");
const EXTRA_SAMPLES: (u16, &str) = (338, "ExtraSamples");
const SAMPLE_FORMAT: (u16, &str) = (339, "SampleFormat");
const JPEG_TABLES: (u16, &str) = (347, "JPEGTables");
const SUBSAMPLING: (u16, &str) = (530, "YCbCrSubSampling");

/// How samples become colours.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Colour {
    /// One band, 0 is black.
    Grey,
    /// One band, 0 is white.
    InvertedGrey,
    /// The first three bands are red, green and blue.
    Rgb,
    /// The first three bands are full-range BT.601 luma and chroma (JPEG).
    YCbCr,
    /// One band of indices into these colours.
    Palette(Vec<[u8; 3]>),
    /// Not an image: one bit per pixel, 1 where the image is valid.
    Mask,
}

/// How chunks are compressed; the numbers are TIFF's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Packing {
    Plain,
    Lzw,
    Jpeg,
    Deflate,
    PackBits,
    Zstd,
    WebP,
}

/// One resolution of the image.
#[derive(Debug, Clone)]
pub(super) struct Level {
    pub directory: Directory,
    pub width: u32,
    pub height: u32,
    /// Samples per pixel in the file.
    pub bands: usize,
    /// Bits per sample: 1 (masks), 8 or 16.
    pub bits: u32,
    pub colour: Colour,
    /// Which band is alpha, if one is.
    pub alpha: Option<usize>,
    pub packing: Packing,
    /// Bands stand in chunks of their own.
    pub planar: bool,
    pub chunk_width: u32,
    pub chunk_height: u32,
    /// Offset and byte count of every chunk, plane after plane.
    pub chunks: Vec<(u64, u64)>,
}

impl Level {
    /// Reads and checks one directory.
    pub fn read(file: &Structure, source: &Source, directory: &Directory) -> Result<Self, Flaw> {
        let one = |tag: (u16, &'static str), default: Option<u64>| -> Result<u64, Flaw> {
            file.unsigned1(source, directory, tag)?.or(default).ok_or_else(|| flaw(tag.1, "a value", "none"))
        };
        let side = |tag: (u16, &'static str)| -> Result<u32, Flaw> {
            let value = one(tag, None)?;
            if value == 0 || value > MAX_SIDE { Err(flaw(tag.1, format!("1 to {MAX_SIDE}"), value)) } else { Ok(value as u32) }
        };
        let (width, height) = (side(WIDTH)?, side(LENGTH)?);
        let bands = one(SAMPLES, Some(1))?;
        if bands == 0 || bands > MAX_BANDS {
            return Err(flaw(SAMPLES.1, format!("1 to {MAX_BANDS}"), bands));
        }
        let planar = match one(PLANAR, Some(1))? {
            1 => false,
            2 => bands > 1,
            other => return Err(flaw(PLANAR.1, "1 (chunky) or 2 (planar)", other)),
        };
        let packing = match one(COMPRESSION, Some(1))? {
            1 => Packing::Plain,
            5 => Packing::Lzw,
            7 => Packing::Jpeg,
            8 | 32946 => Packing::Deflate,
            32773 => Packing::PackBits,
            50000 => Packing::Zstd,
            50001 => Packing::WebP,
            other => {
                return Err(flaw(
                    COMPRESSION.1,
                    "none, LZW, JPEG, DEFLATE, PackBits, ZSTD or WebP (1, 5, 7, 8, 32773, 50000, 50001)",
                    other,
                ));
            }
        };
        let photometric = one(PHOTOMETRIC, None)?;
        let bits = uniform(file, source, directory, BITS, 1)?;
        let wanted_bits: &[u64] = if photometric == 4 { &[1, 8] } else { &[8, 16] };
        if !wanted_bits.contains(&bits) {
            return Err(flaw(BITS.1, format!("one of {wanted_bits:?}"), bits));
        }
        if uniform(file, source, directory, SAMPLE_FORMAT, 1)? != 1 {
            return Err(flaw(SAMPLE_FORMAT.1, "1 (unsigned integers)", "another"));
        }
        if !matches!(one(PREDICTOR, Some(1))?, 1 | 2) {
            return Err(flaw(PREDICTOR.1, "1 (none) or 2 (horizontal)", one(PREDICTOR, Some(1))?));
        }
        let extras = file.unsigned(source, directory, EXTRA_SAMPLES)?.unwrap_or_default();
        if extras.len() as u64 >= bands {
            return Err(flaw(EXTRA_SAMPLES.1, format!("fewer than the {bands} samples of a pixel"), extras.len()));
        }
        let colours = bands as usize - extras.len();
        let alpha = extras.iter().position(|&kind| matches!(kind, 1 | 2)).map(|i| colours + i);
        let colour = match (photometric, bands) {
            (0, 1) => Colour::InvertedGrey,
            (0, _) if colours == 1 => Colour::InvertedGrey,
            // Plain bands without a colour model: three or more are red, green, blue and others, as GDAL writes them.
            (1, 1 | 2) => Colour::Grey,
            (1, _) if alpha.is_some_and(|a| a < 3) => Colour::Grey,
            (1, _) => Colour::Rgb,
            (2, 3..) if alpha.is_none_or(|a| a >= 3) => Colour::Rgb,
            (3, 1) if bits == 8 => Colour::Palette(palette(file, source, directory)?),
            (4, 1) => Colour::Mask,
            (6, 3) if bits == 8 => Colour::YCbCr,
            _ => {
                return Err(flaw(
                    PHOTOMETRIC.1,
                    "grey (0, 1), RGB (2), 8-bit palette (3) or 8-bit YCbCr (6)",
                    format!("{photometric} with {bands} bands of {bits} bits"),
                ));
            }
        };
        if colour == Colour::YCbCr && packing != Packing::Jpeg {
            let subsampling = file.unsigned(source, directory, SUBSAMPLING)?.unwrap_or_else(|| vec![2, 2]);
            if subsampling != [1, 1] {
                return Err(flaw(SUBSAMPLING.1, "1, 1 unless compressed as JPEG", format!("{subsampling:?}")));
            }
        }
        if packing == Packing::Jpeg && (bits != 8 || (!planar && !matches!(bands, 1 | 3 | 4))) {
            return Err(flaw(COMPRESSION.1, "JPEG of 8 bits and 1, 3 or 4 bands", format!("{bands} bands of {bits} bits")));
        }
        if packing == Packing::Jpeg
            && let Some(tables) = file.opaque(source, directory, JPEG_TABLES)?
            && !matches!(embedded::jpeg_size(&tables), Ok(None))
        {
            return Err(flaw(JPEG_TABLES.1, "tables alone", "a frame, or an end in the middle"));
        }

        let tiled = directory.has(TILE_OFFSETS.0);
        let (chunk_width, chunk_height, offsets, counts) = if tiled {
            (side(TILE_WIDTH)?, side(TILE_LENGTH)?, TILE_OFFSETS, TILE_BYTES)
        } else {
            let rows = one(ROWS_PER_STRIP, Some(u64::from(height)))?.min(u64::from(height));
            if rows == 0 {
                return Err(flaw(ROWS_PER_STRIP.1, "at least 1", 0));
            }
            (width, rows as u32, STRIP_OFFSETS, STRIP_BYTES)
        };
        let samples_in_chunk = if planar { 1 } else { bands };
        let chunk_bytes = (u64::from(chunk_width) * u64::from(chunk_height)).saturating_mul(samples_in_chunk * bits.max(8) / 8);
        if chunk_bytes > MAX_CHUNK_BYTES {
            return Err(flaw(
                if tiled { "tile size" } else { ROWS_PER_STRIP.1 },
                format!("at most {MAX_CHUNK_BYTES} decoded bytes (rewrite the map with gdal_translate -co TILED=YES)"),
                chunk_bytes,
            ));
        }
        let across = u64::from(width.div_ceil(chunk_width));
        let down = u64::from(height.div_ceil(chunk_height));
        let expected = across * down * if planar { bands } else { 1 };
        if expected > MAX_VALUES {
            return Err(flaw(offsets.1, format!("at most {MAX_VALUES} chunks"), expected));
        }
        let read = |tag: (u16, &'static str)| -> Result<Vec<u64>, Flaw> {
            let values = file.unsigned(source, directory, tag)?.unwrap_or_default();
            if values.len() as u64 == expected {
                Ok(values)
            } else {
                Err(flaw(tag.1, format!("{expected} values"), values.len()))
            }
        };
        let chunks: Vec<(u64, u64)> = read(offsets)?.into_iter().zip(read(counts)?).collect();
        let beyond = |&(at, count): &(u64, u64)| count != 0 && at.checked_add(count).is_none_or(|end| end > source.len());
        if let Some((i, (at, count))) = chunks.iter().enumerate().find(|(_, c)| beyond(c)) {
            return Err(flaw(
                offsets.1,
                format!("chunk {i} inside the file of {} bytes", source.len()),
                format!("{count} bytes at {at}: the file is truncated or damaged"),
            ));
        }
        Ok(Self {
            directory: directory.clone(),
            width,
            height,
            bands: bands as usize,
            bits: bits as u32,
            colour,
            alpha,
            packing,
            planar,
            chunk_width,
            chunk_height,
            chunks,
        })
    }

    /// Chunks in a row.
    pub fn across(&self) -> u32 {
        self.width.div_ceil(self.chunk_width)
    }

    /// Chunks in a column.
    pub fn down(&self) -> u32 {
        self.height.div_ceil(self.chunk_height)
    }

    /// Chunks of one plane.
    pub fn chunks_per_plane(&self) -> u32 {
        self.across() * self.down()
    }

    /// Whether a chunk was never written (offset or byte count 0): it stands for nodata.
    pub fn is_sparse(&self, chunk: u32) -> bool {
        self.chunks.get(chunk as usize).is_none_or(|&(at, count)| at == 0 || count == 0)
    }
}

/// The one value all samples share.
fn uniform(
    file: &Structure,
    source: &Source,
    directory: &Directory,
    tag: (u16, &'static str),
    default: u64,
) -> Result<u64, Flaw> {
    let values = file.unsigned(source, directory, tag)?.unwrap_or_else(|| vec![default]);
    match values.first() {
        Some(&first) if values.iter().all(|&v| v == first) => Ok(first),
        _ => Err(flaw(tag.1, "the same for every band", format!("{values:?}"))),
    }
}

/// The 256 colours of a palette, 16 bits to 8.
fn palette(file: &Structure, source: &Source, directory: &Directory) -> Result<Vec<[u8; 3]>, Flaw> {
    let values = file.unsigned(source, directory, COLOR_MAP)?.unwrap_or_default();
    let byte = |i: usize| values.get(i).map_or(0, |v| (v >> 8) as u8);
    if values.len() == 768 {
        Ok((0..256).map(|i| [byte(i), byte(256 + i), byte(512 + i)]).collect())
    } else {
        Err(flaw(COLOR_MAP.1, "768 values", values.len()))
    }
}
