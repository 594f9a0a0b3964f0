//! `nightfix locate`: one frame, one prior, one answer.

use super::{Common, Outcome, UsageError};
use crate::bus::FixMessage;
use crate::config::Settings;
use crate::daemon::equip;
use crate::geo::LatLon;
use crate::locate::{EncodedFrame, Localizer, Prior, PriorSource, Query, Seen};
use crate::thermal::{Encoding, Pose};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// Ground metres per frame pixel where the command line says nothing of height or scale.
const DEFAULT_GSD_M: f64 = 1.0;

/// Locate one frame. Ends with 0 whether there is a fix or not (`status` tells), with 2 where it could not be tried.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Satellite map, a GeoTIFF.
    #[arg(long, value_name = "TIF")]
    map: PathBuf,
    /// Model bundle, a folder. Several make a ladder: the smallest whose D_C covers the search radius answers.
    #[arg(long, value_name = "DIR", value_delimiter = ',', required = true)]
    bundle: Vec<PathBuf>,
    /// Thermal frame: PNG, TIFF, JPEG, or raw 16-bit little-endian (.y16, .raw) with --size.
    #[arg(long, value_name = "FILE")]
    frame: PathBuf,
    /// Width and height of a raw frame, for example 640x512.
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<(u32, u32)>,
    /// Latitude of the prior, WGS84 degrees.
    #[arg(long, allow_negative_numbers = true)]
    lat: f64,
    /// Longitude of the prior, WGS84 degrees.
    #[arg(long, allow_negative_numbers = true)]
    lon: f64,
    /// Search radius, metres [default: D_C of the largest bundle].
    #[arg(long)]
    radius_m: Option<f64>,
    /// Ground metres per frame pixel [default: 1 where neither this nor --agl-m is given].
    #[arg(long)]
    gsd_m: Option<f64>,
    /// Height above ground, metres; with the field of view it gives the scale.
    #[arg(long)]
    agl_m: Option<f64>,
    /// Horizontal field of view, degrees [default: camera.hfov_deg of --config].
    #[arg(long)]
    hfov_deg: Option<f64>,
    /// Clockwise from true north to image up, degrees. Unknown by default: a correlation bundle then searches the whole
    /// circle, a matcher bundle takes the frame as north-up.
    #[arg(long, allow_negative_numbers = true)]
    yaw_deg: Option<f64>,
    /// Of the camera, nose up, degrees [default: unknown, nadir is assumed].
    #[arg(long, allow_negative_numbers = true)]
    pitch_deg: Option<f64>,
    /// Of the camera, right side down, degrees [default: unknown, nadir is assumed].
    #[arg(long, allow_negative_numbers = true)]
    roll_deg: Option<f64>,
    /// Exposure, Unix UTC nanoseconds; only echoed.
    #[arg(long, default_value_t = 0, allow_negative_numbers = true)]
    stamp_ns: i64,
    /// `off`: gates from implausible_quad on do not close.
    #[arg(long, value_name = "on|off", default_value = "on", value_parser = parse_switch, action = clap::ArgAction::Set)]
    gates: bool,
    /// Configuration for gates, error budget, ONNX Runtime and field of view [default: the built-in defaults].
    #[arg(long, value_name = "TOML")]
    config: Option<PathBuf>,
    /// The fix message as JSON on stdout instead of a line for people.
    #[arg(long)]
    json: bool,
    /// Writes `window.png` and `frame.png` here: the searched window without its margin, the frame as rectified.
    #[arg(long, value_name = "DIR")]
    dump: Option<PathBuf>,
}

/// Runs it.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let usage = |e: &dyn std::error::Error| UsageError::from_error(e);
    let settings = match &args.config {
        Some(file) => Settings::load(file),
        None => Settings::defaults(),
    };
    let mut settings = settings.map_err(|e| usage(&e))?;
    settings.gates.enabled &= args.gates;
    let at = LatLon::new(args.lat, args.lon);
    let at = at.ok_or_else(|| UsageError(format!("--lat, --lon: expected degrees, found {}, {}", args.lat, args.lon)))?;
    let encoding = encoding_of(&args.frame)?;
    if encoding == Encoding::Y16le && args.size.is_none() {
        return Err(UsageError("--size: expected WxH for a raw frame, found none".into()));
    }
    let bytes = read_frame(&args.frame, settings.daemon.max_frame_bytes as u64)?;
    settings.map.path = Some(args.map.clone());
    settings.bundle.path = args.bundle.first().cloned();
    settings.bundle.ladder = args.bundle.iter().skip(1).cloned().collect();
    let equipment = equip(&settings, common.onnxruntime.as_deref(), &|_| ()).map_err(|e| usage(&e))?;
    let mut localizer = equipment.localizer;

    let searches_circle = localizer.rungs().any(Localizer::searches_circle);
    if args.yaw_deg.is_none() && !searches_circle {
        tracing::warn!("--yaw-deg is not given and this bundle does not search the circle: the frame is taken as north-up");
    }
    let radius_m = args.radius_m.unwrap_or(localizer.largest().search_radius_m());
    if !(radius_m.is_finite() && radius_m > 0.0) {
        return Err(UsageError(format!("--radius-m: expected a positive number of metres, found {radius_m}")));
    }
    let pose = Pose {
        agl_m: args.agl_m,
        gsd_m: args.gsd_m.or_else(|| args.agl_m.is_none().then_some(DEFAULT_GSD_M)),
        hfov_deg: args.hfov_deg.or(settings.camera.hfov_deg),
        yaw_deg: args.yaw_deg.or_else(|| (!searches_circle).then_some(0.0)),
        pitch_deg: args.pitch_deg,
        roll_deg: args.roll_deg,
    };
    let prior = Prior { position: at, radius_m, sigma_m: None, source: PriorSource::External, chain: 0, age_s: None };
    let frame = EncodedFrame { bytes: &bytes, encoding, size_px: args.size };
    let query = Query { stamp_ns: args.stamp_ns, frame: Ok(frame), pose, prior: Ok(prior) };
    let (answer, seen) = localizer.locate_within(&query, &|| true);
    if let Some(folder) = &args.dump {
        let rung = answer.bundle.as_deref().and_then(|name| localizer.rung(name)).unwrap_or(localizer.largest());
        dump(folder, &seen, rung.bundle().manifest.margin_px())?;
    }
    let message = FixMessage::new(args.stamp_ns, 0, &answer, &localizer.name(), &equipment.map);
    let text = if args.json { serde_json::to_string(&message).map_err(|e| usage(&e))? } else { for_people(&message) };
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{text}").map_err(|e| usage(&e))?;
    Ok(Outcome::Done)
}

/// The encoding that a file's name tells.
fn encoding_of(frame: &Path) -> Result<Encoding, UsageError> {
    let extension = frame.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    match extension.as_str() {
        "png" => Ok(Encoding::Png),
        "tif" | "tiff" => Ok(Encoding::Tiff),
        "jpg" | "jpeg" => Ok(Encoding::Jpeg),
        "y16" | "raw" => Ok(Encoding::Y16le),
        _ => Err(UsageError(format!("--frame `{}`: expected .png, .tif, .jpg, .y16 or .raw", frame.display()))),
    }
}

/// A regular file within the bound.
fn read_frame(path: &Path, most: u64) -> Result<Vec<u8>, UsageError> {
    let failed = |why: String| UsageError(format!("--frame `{}`: {why}", path.display()));
    let metadata = std::fs::metadata(path).map_err(|e| failed(e.to_string()))?;
    if !metadata.is_file() || metadata.len() > most {
        return Err(failed(format!("expected a regular file of at most {most} bytes, found {} bytes", metadata.len())));
    }
    let mut bytes = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| failed(e.to_string()))?;
    file.take(most).read_to_end(&mut bytes).map_err(|e| failed(e.to_string()))?;
    Ok(bytes)
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    parsed.ok_or_else(|| "expected WIDTHxHEIGHT, for example 640x512".into())
}

fn parse_switch(text: &str) -> Result<bool, String> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("expected on or off".into()),
    }
}

/// One line.
fn for_people(message: &FixMessage) -> String {
    match (message.position(), message.reason) {
        (Some(at), _) => format!(
            "fix {:.7} {:.7}, 95 % within {:.1} m{}, yaw {:.1} degrees, scale {:.3}, {:.0} ms",
            at.lat_deg,
            at.lon_deg,
            message.radius95_m.unwrap_or(f64::NAN),
            if message.calibrated { "" } else { " (uncalibrated)" },
            message.yaw_deg.unwrap_or(f64::NAN),
            message.scale.unwrap_or(f64::NAN),
            message.latency_ms.get("total").copied().unwrap_or(f64::NAN),
        ),
        (None, reason) => {
            let reason = serde_json::to_value(reason).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default();
            format!("no fix: {reason}: {}", message.detail.as_deref().unwrap_or_default())
        }
    }
}

/// Writes what was looked at.
fn dump(folder: &Path, seen: &Seen, margin_px: usize) -> Result<(), UsageError> {
    let failed = |what: &str, e: &dyn std::fmt::Display| UsageError(format!("--dump `{}`: {what}: {e}", folder.display()));
    std::fs::create_dir_all(folder).map_err(|e| failed("folder", &e))?;
    if let Some(window) = &seen.window {
        let side = window.size_px.saturating_sub(2 * margin_px);
        let lines = window.rgb.chunks_exact(window.size_px * 3).skip(margin_px).take(side);
        let inner: Vec<u8> = lines.flat_map(|line| line.iter().skip(margin_px * 3).take(side * 3)).copied().collect();
        let written = image::save_buffer(folder.join("window.png"), &inner, side as u32, side as u32, image::ColorType::Rgb8);
        written.map_err(|e| failed("window.png", &e))?;
    }
    if let Some(frame) = &seen.frame {
        let side = frame.size_px as u32;
        let written = image::save_buffer(folder.join("frame.png"), &frame.pixels, side, side, image::ColorType::L8);
        written.map_err(|e| failed("frame.png", &e))?;
    }
    Ok(())
}
