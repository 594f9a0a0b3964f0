//! `journal.jsonl`: what is surveyed in the first line, then a line for each cell that is done.

use super::{SurveyError, SurveyOptions};
use crate::locate::Reason;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// The layout.
pub const SCHEMA: u32 = 1;
/// Largest journal read, bytes: a million cells.
const MAX_BYTES: u64 = 1 << 30;

/// What the answers depend on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Layout of the journal.
    pub schema: u32,
    /// Map file name.
    pub map: String,
    /// SHA-256 of the map.
    pub map_digest: String,
    /// Bundle name.
    pub bundle: String,
    /// SHA-256 of its manifest, which names the digests of its graphs.
    pub bundle_digest: String,
    /// SHA-256 of gates and error budget.
    pub settings_digest: String,
    /// Options.
    pub options: SurveyOptions,
}

/// A cell that is done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellRow {
    /// Row by row from the map's top left.
    pub cell: usize,
    /// Its middle.
    pub lat_deg: f64,
    /// Its middle.
    pub lon_deg: f64,
    /// Frames tried; 0 where a frame lies nowhere whole on the map.
    pub frames: usize,
    /// Of them with a fix.
    pub fixes: usize,
    /// Over the fixes, metres.
    pub median_error_m: Option<f64>,
    /// Over the fixes, as stated, metres.
    pub median_radius95_m: Option<f64>,
    /// Fixes wrong by more than 50 m.
    pub over_50m: usize,
    /// Fixes wrong by more than their own `radius999_m`.
    pub beyond_radius999: usize,
    /// "No fix" by reason.
    pub no_fix: BTreeMap<Reason, usize>,
}

impl CellRow {
    /// fixes / frames, where there are frames.
    pub fn coverage(&self) -> Option<f64> {
        (self.frames > 0).then(|| self.fixes as f64 / self.frames as f64)
    }
}

/// The journal, open for more.
pub struct Journal {
    path: PathBuf,
    file: File,
    rows: BTreeMap<usize, CellRow>,
}

impl Journal {
    /// Begins one, or goes on with one of the same survey. A last line that was cut off is dropped.
    pub fn open(folder: &Path, header: &Header, cells: usize) -> Result<Self, SurveyError> {
        let path = folder.join("journal.jsonl");
        let file_error = |error: std::io::Error| SurveyError::File { path: path.clone(), why: error.to_string() };
        let wrong = |line: usize, why: String| SurveyError::File { path: path.clone(), why: format!("line {line}: {why}") };
        let mut file = File::options().read(true).append(true).create(true).open(&path).map_err(file_error)?;
        let mut text = String::new();
        (&mut file).take(MAX_BYTES).read_to_string(&mut text).map_err(file_error)?;
        let whole = text.rfind('\n').map_or(0, |at| at + 1);
        file.set_len(whole as u64).map_err(file_error)?;
        let mut rows = BTreeMap::new();
        let mut lines = text.get(..whole).unwrap_or_default().lines().zip(1..);
        match lines.next() {
            Some((line, number)) => {
                let found: serde_json::Value = serde_json::from_str(line).map_err(|e| wrong(number, e.to_string()))?;
                same(&path, &to_value(&path, header)?, &found)?;
            }
            None => writeln!(file, "{}", to_value(&path, header)?).map_err(file_error)?,
        }
        for (line, number) in lines {
            let row: CellRow = serde_json::from_str(line).map_err(|e| wrong(number, e.to_string()))?;
            if row.cell >= cells {
                return Err(wrong(number, format!("cell: expected less than {cells}, found {}", row.cell)));
            }
            rows.insert(row.cell, row);
        }
        Ok(Self { path, file, rows })
    }

    /// Whether a cell is done.
    pub fn has(&self, cell: usize) -> bool {
        self.rows.contains_key(&cell)
    }

    /// Cells that are done.
    pub fn done(&self) -> usize {
        self.rows.len()
    }

    /// One more.
    pub fn add(&mut self, row: CellRow) -> Result<(), SurveyError> {
        let line = format!("{}\n", to_value(&self.path, &row)?);
        self.file.write_all(line.as_bytes()).map_err(SurveyError::file(&self.path))?;
        self.rows.insert(row.cell, row);
        Ok(())
    }

    /// All, in the order of cells.
    pub fn into_rows(self) -> Vec<CellRow> {
        self.rows.into_values().collect()
    }
}

fn to_value(path: &Path, value: &impl Serialize) -> Result<serde_json::Value, SurveyError> {
    serde_json::to_value(value).map_err(|e| SurveyError::File { path: path.to_owned(), why: e.to_string() })
}

/// Whether two headers are one; else the first field that differs.
fn same(path: &Path, expected: &serde_json::Value, found: &serde_json::Value) -> Result<(), SurveyError> {
    let differs = |field: &str, expected: &serde_json::Value, found: Option<&serde_json::Value>| SurveyError::Other {
        path: path.to_owned(),
        field: field.to_owned(),
        expected: expected.to_string(),
        found: found.map_or_else(|| "nothing".to_owned(), ToString::to_string),
    };
    let Some(fields) = expected.as_object() else { return Ok(()) };
    for (name, value) in fields {
        let other = found.get(name);
        if let (Some(options), Some(others)) = (value.as_object(), other.filter(|other| other.is_object())) {
            for (option, value) in options {
                if others.get(option) != Some(value) {
                    return Err(differs(option, value, others.get(option)));
                }
            }
        } else if other != Some(value) {
            return Err(differs(name, value, other));
        }
    }
    Ok(())
}
