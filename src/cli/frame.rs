//! `nightfix frame`: what the network sees of a frame, or of all frames of a flight.

use super::contact_sheet::contact_sheet;
use super::{Common, Outcome, UsageError};
use crate::flight::Flight;
use crate::thermal::{self, Encoding, GrayFrame, Pose, Samples};
use serde_json::json;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Arguments of `nightfix frame`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The frame: PNG, TIFF, JPEG or raw Y16.
    #[arg(required_unless_present = "contact_sheet")]
    frame: Option<PathBuf>,
    /// Instead of one frame: all of a flight's, rectified, as tiles of one picture, with a cross under the vehicle.
    #[arg(long, value_name = "FLIGHT", conflicts_with = "frame")]
    contact_sheet: Option<PathBuf>,
    /// Ground that a tile of the contact sheet shows, metres.
    #[arg(long, default_value_t = 512.0)]
    width_m: f64,
    /// Side of a tile, pixels.
    #[arg(long, default_value_t = 192)]
    tile_px: usize,
    /// The 8-bit PNG to write.
    #[arg(long, value_name = "PNG")]
    out: PathBuf,
    /// png, tiff, jpeg or y16le; else by the file's ending.
    #[arg(long)]
    encoding: Option<Encoding>,
    /// Width, pixels: needed for raw Y16, checked elsewhere.
    #[arg(long, requires = "height")]
    width: Option<u32>,
    /// Height, pixels: needed for raw Y16, checked elsewhere.
    #[arg(long, requires = "width")]
    height: Option<u32>,
    /// Stop after tone mapping: the whole frame, not rectified.
    #[arg(long)]
    tone_only: bool,
    /// Ground metres per frame pixel at nadir.
    #[arg(long)]
    gsd_m: Option<f64>,
    /// Height above ground, metres (with --hfov-deg).
    #[arg(long)]
    agl_m: Option<f64>,
    /// Horizontal field of view, degrees.
    #[arg(long)]
    hfov_deg: Option<f64>,
    /// Of the camera: clockwise from true north to image up, degrees.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    yaw_deg: f64,
    /// Of the camera: nose up positive, degrees.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    pitch_deg: f64,
    /// Of the camera: right side down positive, degrees.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    roll_deg: f64,
    /// Side of the square, pixels.
    #[arg(long, default_value_t = 512)]
    size_px: usize,
    /// Ground metres per pixel of the square.
    #[arg(long, default_value_t = 1.0)]
    m_per_px: f64,
}

/// Most pixels of a contact sheet: what a picture viewer still opens.
const MAX_SHEET_PX: usize = 1 << 28;

/// Decodes, tone-maps and rectifies, writes the picture and says on stdout what it is. A frame that cannot be used is a
/// usage error; on a contact sheet it is an empty tile, and data loss in the end.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let _ = common;
    let (report, outcome) = match (&args.frame, &args.contact_sheet) {
        (_, Some(folder)) => sheet(&args, folder)?,
        (Some(file), None) => (one_frame(&args, file)?, Outcome::Done),
        (None, None) => return Err(UsageError("frame: expected a frame or --contact-sheet, found neither".into())),
    };
    writeln!(std::io::stdout(), "{report}").map_err(|e| UsageError(format!("stdout: {e}")))?;
    Ok(outcome)
}

fn one_frame(args: &Args, file: &Path) -> Result<serde_json::Value, UsageError> {
    let usage = |error: &dyn std::error::Error| UsageError(format!("`{}`: {error}", file.display()));
    let encoding = args
        .encoding
        .or_else(|| Encoding::of_file(file))
        .ok_or_else(|| UsageError(format!("`{}`: --encoding is needed: the ending says nothing", file.display())))?;
    let bytes = std::fs::read(file).map_err(|e| usage(&e))?;
    let raw = thermal::decode(&bytes, encoding, args.width.zip(args.height)).map_err(|e| usage(&e))?;
    let bits = match raw.samples {
        Samples::U8(_) => 8,
        Samples::U16(_) => 16,
    };
    let toned = thermal::tone_map(&raw);
    let mut report = json!({
        "file": file.display().to_string(), "encoding": encoding, "bits": bits, "width": raw.width, "height": raw.height,
        "out": args.out.display().to_string(),
    });
    let picture = if args.tone_only {
        toned
    } else {
        let pose = Pose {
            agl_m: args.agl_m,
            gsd_m: args.gsd_m,
            hfov_deg: args.hfov_deg,
            yaw_deg: Some(args.yaw_deg),
            pitch_deg: Some(args.pitch_deg),
            roll_deg: Some(args.roll_deg),
        };
        let square = thermal::rectify(&toned, &pose, args.size_px, args.m_per_px).map_err(|e| usage(&e))?;
        report["size_px"] = json!(square.size_px);
        report["m_per_px"] = json!(square.m_per_px);
        report["valid_fraction"] = json!(square.valid_fraction());
        report["vehicle_px"] = json!([square.vehicle_px.0, square.vehicle_px.1]);
        report["agl_m"] = json!(square.agl_m);
        // The size was bounded by `rectify`.
        let side = square.size_px as u32;
        GrayFrame { width: side, height: side, pixels: square.pixels }
    };
    write_png(&args.out, &picture)?;
    Ok(report)
}

fn sheet(args: &Args, folder: &Path) -> Result<(serde_json::Value, Outcome), UsageError> {
    let flight = Flight::open(folder).map_err(|e| UsageError::from_error(&e))?;
    for warning in &flight.warnings {
        tracing::warn!("{warning}");
    }
    let pixels = args.tile_px.checked_mul(args.tile_px).and_then(|tile| tile.checked_mul(flight.rows.len()));
    if args.tile_px == 0 || !pixels.is_some_and(|pixels| (1..=MAX_SHEET_PX).contains(&pixels)) {
        let found = format!("{} tiles of {} px", flight.rows.len(), args.tile_px);
        return Err(UsageError(format!("contact sheet: expected 1 to {MAX_SHEET_PX} pixels in all, found {found}")));
    }
    let sheet = contact_sheet(&flight, args.width_m, args.tile_px);
    for (file, error) in &sheet.failed {
        tracing::warn!("`{file}`: {error}");
    }
    write_png(&args.out, &sheet.picture)?;
    let failed: Vec<_> = sheet.failed.iter().map(|(file, error)| json!({"file": file, "why": error.to_string()})).collect();
    let report = json!({
        "flight": folder.display().to_string(), "out": args.out.display().to_string(), "frames": sheet.frames, "failed": failed,
        "width_m": args.width_m, "tile_px": args.tile_px, "valid_fraction": sheet.valid_fraction,
    });
    Ok((report, if failed.is_empty() { Outcome::Done } else { Outcome::DataLoss }))
}

fn write_png(path: &Path, picture: &GrayFrame) -> Result<(), UsageError> {
    image::save_buffer_with_format(
        path,
        &picture.pixels,
        picture.width,
        picture.height,
        image::ExtendedColorType::L8,
        image::ImageFormat::Png,
    )
    .map_err(|e| UsageError(format!("`{}`: {e}", path.display())))
}
