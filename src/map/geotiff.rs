//! A georeferenced TIFF, opened once and read tile by tile.

use super::MapError;
use super::geokeys::Georeference;
use super::ifd::{Directory, Flaw, Structure, flaw};
use super::level::{Colour, Level};
use super::source::Source;
use crate::geo::{Affine, Crs, LatLon};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

const SUBFILE_TYPE: (u16, &str) = (254, "NewSubfileType");
const SUBFILE_OVERVIEW: u64 = 1;
const SUBFILE_PAGE: u64 = 2;
const SUBFILE_MASK: u64 = 4;
const NODATA: (u16, &str) = (42113, "GDAL_NODATA");
const METADATA: (u16, &str) = (42112, "GDAL_METADATA");

/// An open GeoTIFF: header read and checked, no pixel decoded. [`super::MapCache`] reads its pixels. Clones share the open
/// file, and the digest where it was computed before.
#[derive(Clone)]
pub struct GeoTiff {
    path: PathBuf,
    name: String,
    source: Source,
    big_tiff: bool,
    big_endian: bool,
    /// The full image, then its overviews from fine to coarse.
    levels: Vec<Level>,
    /// Validity masks that stand in directories of their own, of whatever level has their size.
    masks: Vec<Level>,
    nodata: Option<u32>,
    crs: Crs,
    affine: Affine,
    centre: LatLon,
    m_per_px: f64,
    digest: OnceLock<String>,
}

impl GeoTiff {
    /// Opens a map, reads and checks its header. No pixel is decoded.
    pub fn open(path: &Path) -> Result<Self, MapError> {
        let io = |source| MapError::Io { path: path.to_owned(), source };
        let source = Source::new(File::open(path).map_err(io)?).map_err(io)?;
        let format = |(field, expected, found): Flaw| MapError::Format { path: path.to_owned(), field, expected, found };
        let file = Structure::read(&source).map_err(format)?;
        let (mut levels, masks) = read_levels(&file, &source).map_err(format)?;
        let [full, ..] = levels.as_slice() else {
            return Err(format(flaw("directory chain", "a full-resolution image", "none")));
        };
        let Georeference { crs, affine } = Georeference::read(&file, &source, &full.directory).map_err(format)?;
        let nodata = read_nodata(&file, &source, &full.directory).map_err(format)?;
        let denied = full.alpha.map(|band| denies_alpha(&file, &source, &full.directory, band)).transpose().map_err(format)?;

        let (full_width, full_height) = (full.width, full.height);
        if denied == Some(true) {
            levels.iter_mut().for_each(|level| level.alpha = None);
        }
        let (x, y) = (f64::from(full_width - 1) / 2.0, f64::from(full_height - 1) / 2.0);
        let place = |source| MapError::Place { path: path.to_owned(), source };
        let at = |x: f64, y: f64| {
            let (cx, cy) = affine.apply(x, y);
            crs.inverse(cx, cy).map_err(place)
        };
        let centre = at(x, y)?;
        let across_m = at(x - 0.5, y)?.distance_m(at(x + 0.5, y)?);
        let down_m = at(x, y - 0.5)?.distance_m(at(x, y + 0.5)?);
        let m_per_px = (across_m * down_m).sqrt();
        if !(1e-3..=1e5).contains(&m_per_px) {
            return Err(format(flaw("ground pixel", "0.001 to 100000 m", format!("{across_m} x {down_m} m"))));
        }
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        Ok(Self {
            path: path.to_owned(),
            name,
            big_tiff: file.big_tiff,
            big_endian: file.big_endian,
            source,
            levels,
            masks,
            nodata,
            crs,
            affine,
            centre,
            m_per_px,
            digest: OnceLock::new(),
        })
    }

    /// File name without its folder.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// SHA-256 of the whole file, lower-case hex (streamed; computed on first use).
    pub fn digest(&self) -> Result<String, MapError> {
        if let Some(known) = self.digest.get() {
            return Ok(known.clone());
        }
        let mut hasher = Sha256::new();
        let (mut reader, mut buffer) = (self.source.reader(Vec::new()), vec![0; 1 << 16]);
        loop {
            let count = reader.read(&mut buffer).map_err(|source| MapError::Io { path: self.path.clone(), source })?;
            match buffer.get(..count) {
                Some(read) if count > 0 => hasher.update(read),
                _ => break,
            }
        }
        let hex: String = hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(self.digest.get_or_init(|| hex).clone())
    }

    /// Width and height of the full-resolution image, pixels.
    pub fn size_px(&self) -> (u32, u32) {
        self.levels.first().map_or((0, 0), |l| (l.width, l.height))
    }

    /// Its coordinate reference system.
    pub fn crs(&self) -> &Crs {
        &self.crs
    }

    /// Full-resolution pixel (integer = centre of a pixel) -> CRS coordinates.
    pub fn affine(&self) -> &Affine {
        &self.affine
    }

    /// The middle of the image.
    pub fn centre(&self) -> Result<LatLon, MapError> {
        Ok(self.centre)
    }

    /// Ground metres per pixel at the middle (geometric mean of both axes).
    pub fn m_per_px(&self) -> f64 {
        self.m_per_px
    }

    /// Number of reduced-resolution copies in the file.
    pub fn overview_count(&self) -> usize {
        self.levels.len().saturating_sub(1)
    }

    /// The file's path, for errors.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn source(&self) -> &Source {
        &self.source
    }

    pub(super) fn is_big_tiff(&self) -> bool {
        self.big_tiff
    }

    pub(super) fn is_big_endian(&self) -> bool {
        self.big_endian
    }

    pub(super) fn levels(&self) -> &[Level] {
        &self.levels
    }

    /// The mask that belongs to a level, if there is one.
    pub(super) fn mask_of(&self, level: &Level) -> Option<&Level> {
        self.masks.iter().find(|m| (m.width, m.height) == (level.width, level.height))
    }

    /// The sample value that means "no map here".
    pub(super) fn nodata(&self) -> Option<u32> {
        self.nodata
    }

    /// Whether pixels inside written chunks can be invalid.
    pub(super) fn has_pixel_validity(&self) -> bool {
        self.nodata.is_some() || !self.masks.is_empty() || self.levels.iter().any(|l| l.alpha.is_some())
    }
}

/// Sorts the directories into resolutions and masks.
fn read_levels(file: &Structure, source: &Source) -> Result<(Vec<Level>, Vec<Level>), Flaw> {
    let (mut levels, mut masks): (Vec<Level>, Vec<Level>) = (Vec::new(), Vec::new());
    for (i, directory) in file.directories.iter().enumerate() {
        let kind = file.unsigned1(source, directory, SUBFILE_TYPE)?.unwrap_or(0);
        if i == 0 {
            if kind & SUBFILE_MASK != 0 {
                return Err(flaw(SUBFILE_TYPE.1, "an image first", "a mask"));
            }
            levels.push(Level::read(file, source, directory)?);
        } else if kind & SUBFILE_MASK != 0 {
            let mask = Level::read(file, source, directory)?;
            if mask.colour != Colour::Mask {
                return Err(flaw("mask", "PhotometricInterpretation 4", format!("{:?}", mask.colour)));
            }
            masks.push(mask);
        } else if kind & SUBFILE_OVERVIEW != 0 && kind & SUBFILE_PAGE == 0 {
            levels.push(Level::read(file, source, directory)?);
        }
        // Further pages are other images: the map is the first.
    }
    let Some(full) = levels.first() else { return Err(flaw("directory chain", "an image", "none")) };
    if full.colour == Colour::Mask {
        return Err(flaw("PhotometricInterpretation", "an image", "a mask"));
    }
    let (width, height, bands, bits) = (full.width, full.height, full.bands, full.bits);
    if let Some(odd) = levels.iter().find(|l| l.width > width || l.height > height || l.bands != bands || l.bits != bits) {
        return Err(flaw(
            "overview",
            format!("at most {width} x {height} px, {bands} bands, {bits} bits"),
            format!("{} x {} px, {} bands, {} bits", odd.width, odd.height, odd.bands, odd.bits),
        ));
    }
    levels.sort_by_key(|l| std::cmp::Reverse(l.width));
    Ok((levels, masks))
}

/// The nodata value, where it is one that a sample can have.
fn read_nodata(file: &Structure, source: &Source, directory: &Directory) -> Result<Option<u32>, Flaw> {
    let Some(text) = file.text(source, directory, NODATA)? else { return Ok(None) };
    let value: f64 = text.trim().parse().map_err(|_| flaw(NODATA.1, "a number", format!("`{}`", text.trim())))?;
    Ok((value.fract() == 0.0 && (0.0..=65535.0).contains(&value)).then_some(value as u32))
}

/// Whether GDAL's metadata says that this band, which the tags call alpha, is something else: an infra-red band, say.
fn denies_alpha(file: &Structure, source: &Source, directory: &Directory, band: usize) -> Result<bool, Flaw> {
    let Some(text) = file.text(source, directory, METADATA)? else { return Ok(false) };
    let item = format!("sample=\"{band}\" role=\"colorinterp\">");
    let role = text.split_once(&item).and_then(|(_, rest)| rest.split('<').next());
    Ok(role.is_some_and(|role| !role.trim().eq_ignore_ascii_case("alpha")))
}
