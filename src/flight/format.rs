//! A recorded flight as a folder: `flight.toml`, `poses.csv` and the frames it names. Untrusted input: sizes are bounded,
//! paths stay inside the folder, and every error names the file, the row, the column, the expected and the found.
//!
//! Reference: ARCHITECTURE.md, "Recorded flight".

use crate::geo::LatLon;
use crate::thermal::{CameraModel, Encoding, FrameError, Pose};
use crate::track::Spread;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

/// The layout read here.
pub const SCHEMA: u32 = 1;
/// Largest `flight.toml`, bytes.
const MAX_TOML_BYTES: u64 = 1 << 20;
/// Largest `poses.csv`, bytes.
const MAX_CSV_BYTES: u64 = 256 << 20;
/// Most rows.
const MAX_ROWS: usize = 1_000_000;
/// Largest frame file, bytes.
const MAX_FRAME_BYTES: u64 = 64 << 20;
/// The columns that mean something.
const COLUMNS: [&str; 14] = [
    "file",
    "stamp_ns",
    "agl_m",
    "gsd_m",
    "yaw_deg",
    "pitch_deg",
    "roll_deg",
    "prior_lat_deg",
    "prior_lon_deg",
    "prior_sigma_m",
    "prior_radius_m",
    "truth_lat_deg",
    "truth_lon_deg",
    "truth_yaw_deg",
];

/// What is wrong with a flight.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FlightError {
    /// A file is missing, unreadable or too large.
    #[error("flight: `{file}`: {why}")]
    File {
        /// The file.
        file: PathBuf,
        /// The cause.
        why: String,
    },
    /// `flight.toml` does not say what it may say; the text has line and column.
    #[error("flight: `{file}`: {why}")]
    Toml {
        /// The file.
        file: PathBuf,
        /// The parser's words.
        why: String,
    },
    /// A key of `flight.toml` is out of range.
    #[error("flight: `{file}`: `{key}`: expected {expected}, found {found}")]
    Key {
        /// The file.
        file: PathBuf,
        /// The key.
        key: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// The header of `poses.csv`.
    #[error("flight: `{file}`: header: column `{column}`: expected {expected}, found {found}")]
    Header {
        /// The file.
        file: PathBuf,
        /// The column.
        column: String,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// One value of `poses.csv`.
    #[error("flight: `{file}`: row {row} (line {line}): column `{column}`: expected {expected}, found {found}")]
    Cell {
        /// The file.
        file: PathBuf,
        /// Row, from 1, without the header.
        row: usize,
        /// Line of the file.
        line: u64,
        /// The column.
        column: String,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
}

/// A row's prior.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowPrior {
    /// Where.
    pub position: LatLon,
    /// How wide: the radius where both are given; `None` where neither is.
    pub spread: Option<Spread>,
}

/// One frame of a flight. `None` is unknown, never zero.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// The frame's file, relative to the folder, as `poses.csv` writes it.
    pub file: String,
    /// Exposure, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Pose; the field of view is the camera's.
    pub pose: Pose,
    /// Prior.
    pub prior: Option<RowPrior>,
    /// True position of the vehicle.
    pub truth: Option<LatLon>,
    /// True yaw, degrees clockwise from true north.
    pub truth_yaw_deg: Option<f64>,
}

/// A recorded flight.
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    /// Its folder.
    pub folder: PathBuf,
    /// Its name.
    pub name: Option<String>,
    /// Its map, where it names one: folder and relative path joined.
    pub map: Option<PathBuf>,
    /// Notes.
    pub notes: Option<String>,
    /// The camera.
    pub camera: CameraModel,
    /// Frames, in the file's order.
    pub rows: Vec<Row>,
    /// What was ignored, for the log.
    pub warnings: Vec<String>,
}

/// `flight.toml` as written. Every key is optional.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Header {
    schema: Option<u32>,
    name: Option<String>,
    map: Option<String>,
    notes: Option<String>,
    camera: HeaderCamera,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct HeaderCamera {
    hfov_deg: Option<f64>,
    mount_roll_deg: f64,
    mount_pitch_deg: f64,
    mount_yaw_deg: f64,
}

impl Flight {
    /// Reads a flight's folder; no frame is opened.
    pub fn open(folder: &Path) -> Result<Self, FlightError> {
        let toml_file = folder.join("flight.toml");
        let header = read_header(&toml_file)?;
        let map = match &header.map {
            Some(map) => {
                let found = map.clone();
                let expected = "a path relative to the folder, without `..`";
                Some(inside(folder, map).ok_or(FlightError::Key { file: toml_file.clone(), key: "map", expected, found })?)
            }
            None => None,
        };
        let camera = header.camera;
        let camera = CameraModel {
            hfov_deg: camera.hfov_deg,
            mount_roll_deg: camera.mount_roll_deg,
            mount_pitch_deg: camera.mount_pitch_deg,
            mount_yaw_deg: camera.mount_yaw_deg,
        };
        let csv_file = folder.join("poses.csv");
        let text = read_bounded(&csv_file, MAX_CSV_BYTES)?;
        let (rows, warnings) = read_rows(&csv_file, &text)?;
        Ok(Self { folder: folder.to_owned(), name: header.name, map, notes: header.notes, camera, rows, warnings })
    }

    /// Reads a row's frame and tells how it is encoded, by its file's extension.
    pub fn frame(&self, row: &Row) -> Result<(Vec<u8>, Encoding), FrameError> {
        let unreadable = |why: String| FrameError::Unreadable { file: row.file.clone(), why };
        let path = inside(&self.folder, &row.file).ok_or_else(|| unreadable("the path leaves the flight's folder".into()))?;
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        let encoding = match extension.as_str() {
            "png" => Encoding::Png,
            "tif" | "tiff" => Encoding::Tiff,
            "jpg" | "jpeg" => Encoding::Jpeg,
            _ => return Err(unreadable(format!("expected the extension png, tif, tiff, jpg or jpeg, found `{extension}`"))),
        };
        let bytes = read_file(&path, MAX_FRAME_BYTES).map_err(unreadable)?;
        Ok((bytes, encoding))
    }
}

/// A path below the folder, or `None` where it is empty, absolute or climbs out.
fn inside(folder: &Path, relative: &str) -> Option<PathBuf> {
    let path = Path::new(relative);
    let stays = !relative.is_empty() && path.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    stays.then(|| folder.join(path))
}

/// A regular file's bytes, bounded (a pipe or a device would never end).
fn read_file(path: &Path, limit: u64) -> Result<Vec<u8>, String> {
    let meta = std::fs::metadata(path).map_err(|e| e.to_string())?;
    if !meta.is_file() {
        return Err("expected a file, found something else".into());
    }
    if meta.len() > limit {
        return Err(format!("expected at most {limit} bytes, found {}", meta.len()));
    }
    let file = std::fs::File::open(path).map_err(|e| e.to_string())?;
    let mut bytes = Vec::with_capacity(meta.len() as usize);
    file.take(limit).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
    Ok(bytes)
}

fn read_bounded(file: &Path, limit: u64) -> Result<String, FlightError> {
    let error = |why: String| FlightError::File { file: file.to_owned(), why };
    let text = String::from_utf8(read_file(file, limit).map_err(error)?).map_err(|e| error(format!("expected UTF-8: {e}")))?;
    Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
}

fn read_header(file: &Path) -> Result<Header, FlightError> {
    let text = read_bounded(file, MAX_TOML_BYTES)?;
    let header: Header = toml::from_str(&text)
        .map_err(|e| FlightError::Toml { file: file.to_owned(), why: e.to_string().trim_end().to_owned() })?;
    let key = |key, expected, found: String| Err(FlightError::Key { file: file.to_owned(), key, expected, found });
    if let Some(schema) = header.schema.filter(|s| *s != SCHEMA) {
        return key("schema", "1", schema.to_string());
    }
    if let Some(hfov) = header.camera.hfov_deg.filter(|v| !(*v > 0.0 && *v < 180.0)) {
        return key("camera.hfov_deg", "more than 0 and less than 180", hfov.to_string());
    }
    let mounts = [
        ("camera.mount_roll_deg", header.camera.mount_roll_deg),
        ("camera.mount_pitch_deg", header.camera.mount_pitch_deg),
        ("camera.mount_yaw_deg", header.camera.mount_yaw_deg),
    ];
    for (name, value) in mounts {
        if !(-360.0..=360.0).contains(&value) {
            return key(name, "-360 to 360", value.to_string());
        }
    }
    Ok(header)
}

/// One line of `poses.csv`, by column.
struct Line<'a> {
    file: &'a Path,
    row: usize,
    line: u64,
    cells: BTreeMap<&'static str, &'a str>,
}

impl Line<'_> {
    fn error(&self, column: &str, expected: &'static str, found: &str) -> FlightError {
        FlightError::Cell {
            file: self.file.to_owned(),
            row: self.row,
            line: self.line,
            column: column.to_owned(),
            expected,
            found: if found.is_empty() { "nothing".into() } else { format!("`{found}`") },
        }
    }
    /// The value of a column; empty and absent are unknown.
    fn number(&self, column: &'static str, expected: &'static str, ok: impl Fn(f64) -> bool) -> Result<Option<f64>, FlightError> {
        let Some(text) = self.cells.get(column).filter(|t| !t.is_empty()) else { return Ok(None) };
        match text.parse::<f64>() {
            Ok(value) if value.is_finite() && ok(value) => Ok(Some(value)),
            _ => Err(self.error(column, expected, text)),
        }
    }
    /// A latitude and a longitude, both or neither.
    fn position(&self, lat: &'static str, lon: &'static str) -> Result<Option<LatLon>, FlightError> {
        let lat_deg = self.number(lat, "a latitude, -90 to 90", |v| v.abs() <= 90.0)?;
        let lon_deg = self.number(lon, "a longitude, -180 to 180", |v| v.abs() <= 180.0)?;
        match (lat_deg, lon_deg) {
            (Some(lat_deg), Some(lon_deg)) => Ok(Some(LatLon { lat_deg, lon_deg })),
            (None, None) => Ok(None),
            (None, Some(_)) => Err(self.error(lat, "a latitude beside the longitude", "")),
            (Some(_), None) => Err(self.error(lon, "a longitude beside the latitude", "")),
        }
    }
    fn read(&self) -> Result<Row, FlightError> {
        let text = |column: &'static str| self.cells.get(column).copied().unwrap_or("");
        let file = text("file");
        if inside(Path::new(""), file).is_none() {
            return Err(self.error("file", "a path relative to the folder, without `..`", file));
        }
        let stamp = text("stamp_ns");
        let stamp_ns = stamp.parse().map_err(|_| self.error("stamp_ns", "whole nanoseconds since 1970 UTC", stamp))?;
        let positive = |v: f64| v > 0.0;
        let angle = |v: f64| v.abs() <= 360.0;
        let tilt = |v: f64| v.abs() <= 180.0;
        let pose = Pose {
            agl_m: self.number("agl_m", "a positive number", positive)?,
            gsd_m: self.number("gsd_m", "a positive number", positive)?,
            hfov_deg: None,
            yaw_deg: self.number("yaw_deg", "degrees, -360 to 360", angle)?,
            pitch_deg: self.number("pitch_deg", "degrees, -180 to 180", tilt)?,
            roll_deg: self.number("roll_deg", "degrees, -180 to 180", tilt)?,
        };
        let position = self.position("prior_lat_deg", "prior_lon_deg")?;
        let radius_m = self.number("prior_radius_m", "a positive number", positive)?;
        let sigma_m = self.number("prior_sigma_m", "a positive number", positive)?;
        if position.is_none() && (radius_m.is_some() || sigma_m.is_some()) {
            return Err(self.error("prior_lat_deg", "a position beside the prior's width", ""));
        }
        let spread = radius_m.map(Spread::RadiusM).or(sigma_m.map(Spread::SigmaM));
        let truth = self.position("truth_lat_deg", "truth_lon_deg")?;
        let truth_yaw_deg = self.number("truth_yaw_deg", "degrees, -360 to 360", angle)?;
        Ok(Row {
            file: file.to_owned(),
            stamp_ns,
            pose,
            prior: position.map(|position| RowPrior { position, spread }),
            truth,
            truth_yaw_deg,
        })
    }
}

fn read_rows(file: &Path, text: &str) -> Result<(Vec<Row>, Vec<String>), FlightError> {
    let broken = |e: csv::Error| FlightError::File { file: file.to_owned(), why: e.to_string() };
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(text.as_bytes());
    let header = reader.headers().map_err(broken)?.clone();
    let bad_header = |column: &str, expected, found: &str| {
        Err(FlightError::Header { file: file.to_owned(), column: column.to_owned(), expected, found: found.to_owned() })
    };
    let mut columns: Vec<Option<&'static str>> = Vec::new();
    let mut warnings = Vec::new();
    for name in &header {
        let known = COLUMNS.iter().find(|c| **c == name).copied();
        if known.is_some() && columns.contains(&known) {
            return bad_header(name, "it once", "it twice");
        }
        if known.is_none() {
            warnings.push(format!("`{}`: column `{name}` is unknown and ignored", file.display()));
        }
        columns.push(known);
    }
    for needed in ["file", "stamp_ns"] {
        if !columns.contains(&Some(needed)) {
            let found = header.iter().collect::<Vec<_>>().join(",");
            return bad_header(needed, "it among the columns", if found.is_empty() { "an empty file" } else { &found });
        }
    }
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(broken)?;
        if rows.len() == MAX_ROWS {
            let why = format!("expected at most {MAX_ROWS} rows, found more");
            return Err(FlightError::File { file: file.to_owned(), why });
        }
        let cells = columns.iter().zip(&record).filter_map(|(c, cell)| Some(((*c)?, cell))).collect();
        let line = record.position().map_or(0, csv::Position::line);
        rows.push(Line { file, row: rows.len() + 1, line, cells }.read()?);
    }
    Ok((rows, warnings))
}

#[cfg(test)]
#[path = "format_tests.rs"]
mod tests;
