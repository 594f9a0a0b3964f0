//! `nightfix frame`: what the network sees of a frame.

use super::{Common, Outcome, UsageError};
use crate::thermal::{self, Encoding, GrayFrame, Pose, Samples};
use serde_json::json;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Arguments of `nightfix frame`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The frame: PNG, TIFF, JPEG or raw Y16.
    frame: PathBuf,
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

/// Decodes, tone-maps and rectifies a frame, writes the picture and says on stdout what it is.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let _ = common;
    let usage = |error: &dyn std::error::Error| UsageError(format!("`{}`: {error}", args.frame.display()));
    let encoding = args
        .encoding
        .or_else(|| Encoding::of_file(&args.frame))
        .ok_or_else(|| UsageError(format!("`{}`: --encoding is needed: the ending says nothing", args.frame.display())))?;
    let bytes = std::fs::read(&args.frame).map_err(|e| usage(&e))?;
    let raw = thermal::decode(&bytes, encoding, args.width.zip(args.height)).map_err(|e| usage(&e))?;
    let bits = match raw.samples {
        Samples::U8(_) => 8,
        Samples::U16(_) => 16,
    };
    let toned = thermal::tone_map(&raw);
    let mut report = json!({
        "file": args.frame.display().to_string(), "encoding": encoding, "bits": bits, "width": raw.width, "height": raw.height,
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
    writeln!(std::io::stdout(), "{report}").map_err(|e| UsageError(format!("stdout: {e}")))?;
    Ok(Outcome::Done)
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
