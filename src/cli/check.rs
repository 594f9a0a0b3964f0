//! `nightfix check`: everything that `run` needs, without running it.

use super::{Common, Outcome, UsageError};
use crate::bus::zenoh_config;
use crate::config::Settings;
use crate::locate::Ladder;
use crate::map::{GeoTiff, MapCache, WindowSpec};
use crate::model::{Bundle, Provider, Runtime};
use serde_json::{Map, Value, json};
use std::error::Error;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Arguments of `nightfix check`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Configuration: states only what differs from config/nightfix.toml.
    #[arg(long, value_name = "F")]
    config: PathBuf,
}

/// A part's own report, or what is wrong with it.
type Part<T> = Result<(T, Value), Box<dyn Error>>;

/// Checks every part, also after one failed, and prints one JSON object: `ok`, and for each part `ok` with what it is
/// or an `error`. Not ok is exit 2.
pub fn run(common: &Common, args: Args) -> Result<Outcome, UsageError> {
    let mut report = Report::default();
    let settings = report.part("configuration", load(&args));
    if let Some(settings) = settings {
        report.part("zenoh", zenoh(&settings));
        let runtime = report.part("onnxruntime", runtime(common, &settings));
        let bundle = match &runtime {
            Some(runtime) => report.part("bundle", bundle(&settings, runtime)),
            None => report.part("bundle", Err("not checked: ONNX Runtime could not be loaded".into())),
        };
        let further = match &runtime {
            _ if settings.bundle.ladder.is_empty() => Some(Vec::new()),
            Some(runtime) => report.part("ladder", ladder(&settings, runtime)),
            None => report.part("ladder", Err("not checked: ONNX Runtime could not be loaded".into())),
        };
        let map = report.part("map", map(&settings, bundle.as_ref()));
        if let (Some(bundle), Some(further), Some(map)) = (bundle, further, map) {
            report.part("localizer", localizer(&settings, bundle, further, &map));
        }
    }
    report.print()
}

#[derive(Default)]
struct Report {
    parts: Map<String, Value>,
    errors: Vec<String>,
}

impl Report {
    /// Notes a part; gives it back where it is well.
    fn part<T>(&mut self, name: &str, part: Part<T>) -> Option<T> {
        let (found, value) = match part {
            Ok((found, mut value)) => {
                if let Some(object) = value.as_object_mut() {
                    object.insert("ok".to_owned(), true.into());
                }
                (Some(found), value)
            }
            Err(error) => {
                let text = UsageError::from_error(error.as_ref()).0;
                let value = json!({"ok": false, "error": text});
                self.errors.push(text);
                (None, value)
            }
        };
        self.parts.insert(name.to_owned(), value);
        found
    }

    fn print(mut self) -> Result<Outcome, UsageError> {
        self.parts.insert("ok".to_owned(), self.errors.is_empty().into());
        writeln!(std::io::stdout(), "{:#}", Value::Object(self.parts))
            .map_err(|e| UsageError(format!("standard output: {e}")))?;
        if self.errors.is_empty() { Ok(Outcome::Done) } else { Err(UsageError(self.errors.join("; "))) }
    }
}

fn load(args: &Args) -> Part<Settings> {
    let settings = Settings::load(&args.config)?;
    let value = json!({"file": args.config, "vehicle": settings.vehicle.name});
    Ok((settings, value))
}

/// Zenoh's settings are understood. No session is opened: a service may be running.
fn zenoh(settings: &Settings) -> Part<()> {
    zenoh_config(&settings.zenoh, settings.daemon.max_frame_bytes)?;
    let zenoh = &settings.zenoh;
    Ok(((), json!({"mode": zenoh.mode, "connect": zenoh.connect.endpoints, "listen": zenoh.listen.endpoints})))
}

fn runtime(common: &Common, settings: &Settings) -> Part<Runtime> {
    let provider: Provider = settings.onnxruntime.provider.parse()?;
    let configured = settings.onnxruntime.library.as_deref();
    let runtime = Runtime::open(common.onnxruntime.as_deref(), configured, provider, settings.onnxruntime.threads)?;
    let value = json!({"library": runtime.library(), "provider": provider.name(), "threads": settings.onnxruntime.threads});
    Ok((runtime, value))
}

/// Manifest, digests, graphs, golden pair on the execution provider asked for.
fn bundle(settings: &Settings, runtime: &Runtime) -> Part<Bundle> {
    let folder = settings.bundle.path.as_deref().ok_or("configuration: bundle.path: expected a bundle's folder, found none")?;
    open_bundle(folder, runtime)
}

/// The further bundles, all of them, each like the first.
fn ladder(settings: &Settings, runtime: &Runtime) -> Part<Vec<Bundle>> {
    let opened = settings.bundle.ladder.iter().map(|folder| open_bundle(folder, runtime)).collect::<Result<Vec<_>, _>>()?;
    let (bundles, values): (Vec<Bundle>, Vec<Value>) = opened.into_iter().unzip();
    Ok((bundles, json!({"bundles": values})))
}

fn open_bundle(folder: &Path, runtime: &Runtime) -> Part<Bundle> {
    let bundle = Bundle::open(folder, runtime)?;
    let manifest = &bundle.manifest;
    let golden: Vec<Value> =
        bundle.golden.iter().map(|g| json!({"array": g.array, "difference": g.difference, "tolerance": g.tolerance})).collect();
    let value = json!({
        "path": folder, "name": manifest.name, "licence": manifest.licence, "search_radius_m": manifest.search_radius_m,
        "window_width_m": manifest.window_width_m, "stages": if manifest.refine.is_some() { 2 } else { 1 }, "golden": golden,
    });
    Ok((bundle, value))
}

/// The map opens, and somewhere on it there is room for a footprint.
fn map(settings: &Settings, bundle: Option<&Bundle>) -> Part<GeoTiff> {
    let path = settings.map.path.as_deref().ok_or("configuration: map.path: expected a GeoTIFF, found none")?;
    let map = GeoTiff::open(path)?;
    let (width_px, height_px) = map.size_px();
    let (centre, m_per_px) = (map.centre()?, map.m_per_px());
    let mut value = json!({
        "path": path, "name": map.name(), "digest": map.digest()?, "size_px": [width_px, height_px], "m_per_px": m_per_px,
        "centre": {"lat_deg": centre.lat_deg, "lon_deg": centre.lon_deg},
    });
    let half_diagonal_m = 0.5 * m_per_px * f64::from(width_px).hypot(f64::from(height_px));
    let footprint_m = bundle.map_or(512.0, |bundle| bundle.manifest.frame_width_m);
    let share = settings.gates.min_map_valid;
    let mut cache = MapCache::new(map.clone(), settings.map.cache_mib.saturating_mul(1 << 20));
    let middle = cache.window(&WindowSpec { centre, width_m: footprint_m, m_per_px: 1.0 })?.valid_fraction();
    // A look at the middle first: the search is coarse.
    if middle < share && !cache.can_hold(centre, half_diagonal_m, footprint_m, share)? {
        let text = format!(
            "map `{}`: coverage: expected room for {footprint_m} m x {footprint_m} m that is {share} valid, found none",
            path.display()
        );
        return Err(text.into());
    }
    if let Some(object) = value.as_object_mut() {
        object.insert("valid_in_the_middle".to_owned(), middle.into());
    }
    Ok((map, value))
}

/// All of it goes together.
fn localizer(settings: &Settings, bundle: Bundle, further: Vec<Bundle>, map: &GeoTiff) -> Part<()> {
    let cache_bytes = settings.map.cache_mib.saturating_mul(1 << 20);
    let ladder = Ladder::new(bundle, further, map, cache_bytes, &settings.gates, &settings.budget, &settings.search)?;
    let rungs: Vec<Value> = ladder
        .rungs()
        .map(|rung| json!({"bundle": rung.bundle().manifest.name, "search_radius_m": rung.search_radius_m()}))
        .collect();
    let search = json!({"kind": ladder.search_kind(), "max_radius_m": settings.search.max_radius_m});
    Ok(((), json!({"ladder": rungs, "search": search, "gates": settings.gates.enabled})))
}
