//! What a survey leaves: `survey.tif` (opens in QGIS), `survey.csv`, `survey.png`, and a short table.

use super::{CellRow, Survey, SurveyError};
use crate::geo::Affine;
use crate::map::{GeoTiff, MapCache, WindowSpec, write_bands};
use serde::Serialize;
use std::path::Path;

/// Longer side of the picture, pixels.
const PICTURE_PX: f64 = 1024.0;
/// Decoded tiles kept for the picture.
const CACHE_BYTES: usize = 256 << 20;
/// Weight of the colour over the map.
const OPACITY: f64 = 0.55;

/// The short table. Shares are of cells with frames; medians over cells with fixes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Cells over the map.
    pub cells: usize,
    /// Cells in which a frame lies whole on the map.
    pub cells_with_frames: usize,
    /// Frames tried.
    pub frames: usize,
    /// Fixes.
    pub fixes: usize,
    /// fixes / frames.
    pub coverage: Option<f64>,
    /// Cells with at least 90 % coverage.
    pub share_from_90: Option<f64>,
    /// Cells with at least 50 %, under 90 %.
    pub share_50_to_90: Option<f64>,
    /// Cells under 50 %.
    pub share_under_50: Option<f64>,
    /// Median of the cells' median errors, metres.
    pub median_error_m: Option<f64>,
    /// Median of the cells' median stated 95 % radii, metres.
    pub median_radius95_m: Option<f64>,
    /// Fixes wrong by more than 50 m.
    pub over_50m: usize,
    /// Fixes wrong by more than their own `radius999_m`.
    pub beyond_radius999: usize,
}

/// Writes GeoTIFF, table and picture into the folder.
pub fn write_outputs(survey: &Survey, map_path: &Path, folder: &Path) -> Result<Summary, SurveyError> {
    let grid = &survey.grid;
    let band = |value: &dyn Fn(&CellRow) -> Option<f64>| -> Vec<f32> {
        survey.rows.iter().map(|row| value(row).map_or(f32::NAN, |v| v as f32)).collect()
    };
    let (coverage, error_m, radius_m) =
        (band(&CellRow::coverage), band(&|row| row.median_error_m), band(&|row| row.median_radius95_m));
    let bands = [("coverage", &*coverage), ("median_error_m", &*error_m), ("median_radius95_m", &*radius_m)];
    write_bands(&folder.join("survey.tif"), &bands, grid.columns, grid.rows, &grid.affine(), &grid.crs)?;
    write_csv(survey, &folder.join("survey.csv"))?;
    write_picture(survey, map_path, &folder.join("survey.png"))?;
    Ok(summary(&survey.rows))
}

fn summary(rows: &[CellRow]) -> Summary {
    let tried: Vec<f64> = rows.iter().filter_map(CellRow::coverage).collect();
    let share = |fits: &dyn Fn(f64) -> bool| {
        let count = tried.iter().filter(|coverage| fits(**coverage)).count();
        (!tried.is_empty()).then(|| count as f64 / tried.len() as f64)
    };
    let median_of =
        |value: &dyn Fn(&CellRow) -> Option<f64>| super::median(&mut rows.iter().filter_map(value).collect::<Vec<f64>>());
    let sum = |value: &dyn Fn(&CellRow) -> usize| rows.iter().map(value).sum::<usize>();
    let (frames, fixes) = (sum(&|row| row.frames), sum(&|row| row.fixes));
    Summary {
        cells: rows.len(),
        cells_with_frames: tried.len(),
        frames,
        fixes,
        coverage: (frames > 0).then(|| fixes as f64 / frames as f64),
        share_from_90: share(&|c| c >= 0.9),
        share_50_to_90: share(&|c| (0.5..0.9).contains(&c)),
        share_under_50: share(&|c| c < 0.5),
        median_error_m: median_of(&|row| row.median_error_m),
        median_radius95_m: median_of(&|row| row.median_radius95_m),
        over_50m: sum(&|row| row.over_50m),
        beyond_radius999: sum(&|row| row.beyond_radius999),
    }
}

fn write_csv(survey: &Survey, path: &Path) -> Result<(), SurveyError> {
    let text = |value: Option<f64>, digits: usize| value.map_or_else(String::new, |v| format!("{v:.digits$}"));
    let mut table = String::from(
        "row,column,lat_deg,lon_deg,frames,fixes,coverage,median_error_m,median_radius95_m,over_50m,beyond_radius999,no_fix\n",
    );
    for row in &survey.rows {
        let (column, line) = survey.grid.place(row.cell);
        let reasons: Vec<String> = row
            .no_fix
            .iter()
            .map(|(reason, count)| {
                let name = serde_json::to_value(reason).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default();
                format!("{name}={count}")
            })
            .collect();
        table += &format!(
            "{line},{column},{:.7},{:.7},{},{},{},{},{},{},{},{}\n",
            row.lat_deg,
            row.lon_deg,
            row.frames,
            row.fixes,
            text(row.coverage(), 3),
            text(row.median_error_m, 2),
            text(row.median_radius95_m, 2),
            row.over_50m,
            row.beyond_radius999,
            reasons.join(" "),
        );
    }
    std::fs::write(path, table).map_err(SurveyError::file(path))
}

/// The map, north up, with each cell's coverage as a colour: red 0, yellow 0.5, green 1; cells without frames as they are.
fn write_picture(survey: &Survey, map_path: &Path, path: &Path) -> Result<(), SurveyError> {
    let map = GeoTiff::open(map_path)?;
    let all: Vec<usize> = (0..survey.grid.cells()).collect();
    let window = survey.grid.window(&all, 0.0)?;
    let spec = WindowSpec { m_per_px: (window.width_m / PICTURE_PX).max(map.m_per_px()), ..window };
    let pixels = MapCache::new(map, CACHE_BYTES).window(&spec)?;
    let side = pixels.size_px;
    let to_map = Affine(pixels.map_affine);
    let mut rgb = pixels.rgb.clone();
    for (i, pixel) in rgb.chunks_exact_mut(3).enumerate() {
        let (x, y) = to_map.apply((i % side) as f64, (i / side) as f64);
        let row = survey.grid.cell_at(x, y).and_then(|cell| survey.rows.get(cell));
        if let Some(coverage) = row.and_then(CellRow::coverage) {
            for (channel, colour) in pixel.iter_mut().zip(colour(coverage)) {
                *channel = (f64::from(*channel) * (1.0 - OPACITY) + colour * OPACITY).round() as u8;
            }
        }
    }
    image::save_buffer(path, &rgb, side as u32, side as u32, image::ColorType::Rgb8)
        .map_err(|e| SurveyError::File { path: path.to_owned(), why: e.to_string() })
}

fn colour(coverage: f64) -> [f64; 3] {
    let (low, high) = ((2.0 * coverage).min(1.0), (2.0 - 2.0 * coverage).min(1.0));
    [220.0 * high, 200.0 * low, 40.0]
}
