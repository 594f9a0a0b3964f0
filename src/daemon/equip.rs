//! What the service runs with: ONNX Runtime, bundles, map, localizer. Shared by `run`, `replay` and `locate`.

use super::DaemonError;
use crate::bus::MapId;
use crate::config::Settings;
use crate::locate::Ladder;
use crate::map::GeoTiff;
use crate::model::{Bundle, Provider, Runtime};
use std::path::{Path, PathBuf};

/// What the service runs with.
pub struct Equipment {
    /// The localizers, their bundles' golden pairs checked on the execution provider really in use.
    pub localizer: Ladder,
    /// The map, for messages.
    pub map: MapId,
    /// ONNX Runtime's library.
    pub library: PathBuf,
    /// Execution provider.
    pub provider: Provider,
}

/// Loads and checks everything. `progress` is told what is being done.
pub fn equip(settings: &Settings, onnxruntime: Option<&Path>, progress: &dyn Fn(&str)) -> Result<Equipment, DaemonError> {
    let missing = |field, expected| DaemonError::Missing { field, expected };
    let map_path = settings.map.path.as_deref().ok_or_else(|| missing("map.path", "a GeoTIFF"))?;
    let folder = settings.bundle.path.as_deref().ok_or_else(|| missing("bundle.path", "a bundle's folder"))?;

    progress("loading ONNX Runtime");
    let provider: Provider = settings.onnxruntime.provider.parse()?;
    let configured = settings.onnxruntime.library.as_deref();
    let runtime = Runtime::open(onnxruntime, configured, provider, settings.onnxruntime.threads)?;

    progress("loading the bundle and checking its golden pair");
    let bundle = Bundle::open(folder, &runtime)?;
    let further = settings.bundle.ladder.iter().map(|folder| Bundle::open(folder, &runtime)).collect::<Result<Vec<_>, _>>()?;

    progress("opening the map");
    let map = GeoTiff::open(map_path)?;
    // The digest reads the whole file: done here, once, and not before the first answer.
    let id = MapId { name: map.name().to_owned(), digest: map.digest()? };
    let cache_bytes = settings.map.cache_mib.saturating_mul(1 << 20);
    let localizer = Ladder::new(bundle, further, &map, cache_bytes, &settings.gates, &settings.budget, &settings.search)?;
    Ok(Equipment { localizer, map: id, library: runtime.library().to_owned(), provider })
}
