//! Finding and loading ONNX Runtime.
//!
//! The library is loaded once per process, with `ort::init_from` and nothing else: `ort`'s lazy route panics where the
//! library is missing. `ort` allows one environment per process, so it lives in a static until the process ends.

use ort::ep;
use ort::session::Session;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Execution provider: what runs the graphs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Provider {
    /// CPU.
    Cpu,
    /// CUDA.
    Cuda,
    /// TensorRT.
    TensorRt,
    /// XNNPACK.
    Xnnpack,
}

impl Provider {
    /// The names `onnxruntime.provider` may take.
    pub const NAMES: &'static str = "cpu, cuda, tensorrt or xnnpack";

    /// The name in configuration and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
            Self::Xnnpack => "xnnpack",
        }
    }
}

impl std::str::FromStr for Provider {
    type Err = RuntimeError;
    fn from_str(name: &str) -> Result<Self, RuntimeError> {
        [Self::Cpu, Self::Cuda, Self::TensorRt, Self::Xnnpack]
            .into_iter()
            .find(|p| p.name() == name)
            .ok_or_else(|| RuntimeError::UnknownProvider { found: name.to_owned() })
    }
}

/// Why ONNX Runtime cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RuntimeError {
    /// None found.
    #[error("ONNX Runtime was not found; tried: {tried}")]
    NotFound {
        /// The places, joined.
        tried: String,
    },
    /// Found, but not usable: not a library, too old, not ONNX Runtime.
    #[error("ONNX Runtime `{library}` cannot be loaded: {why}")]
    Load {
        /// The file.
        library: PathBuf,
        /// The loader's words.
        why: String,
    },
    /// A process holds one ONNX Runtime; another file was asked for.
    #[error("ONNX Runtime: expected `{asked}`, found `{loaded}` already loaded in this process")]
    AlreadyLoaded {
        /// What is asked for now.
        asked: PathBuf,
        /// What is loaded.
        loaded: PathBuf,
    },
    /// `onnxruntime.provider` names none that is known.
    #[error("onnxruntime.provider: expected {}, found `{found}`", Provider::NAMES)]
    UnknownProvider {
        /// What it says.
        found: String,
    },
    /// `onnxruntime.threads` is out of range.
    #[error("onnxruntime.threads: expected 1 to {MAX_THREADS}, found {found}")]
    Threads {
        /// What it says.
        found: usize,
    },
}

/// More threads than any machine this runs on has cores.
const MAX_THREADS: usize = 256;

/// The process's only environment and the file it came from.
static LOADED: Mutex<Option<(PathBuf, ort::environment::Environment)>> = Mutex::new(None);

/// ONNX Runtime, loaded, with the settings all sessions share.
#[derive(Debug, Clone)]
pub struct Runtime {
    environment: ort::environment::Environment,
    library: PathBuf,
    provider: Provider,
    threads: usize,
}

impl Runtime {
    /// Finds and loads ONNX Runtime: see [`find_library`] and [`Runtime::load`].
    pub fn open(
        explicit: Option<&Path>,
        configured: Option<&Path>,
        provider: Provider,
        threads: usize,
    ) -> Result<Self, RuntimeError> {
        Self::load(&find_library(explicit, configured)?, provider, threads)
    }

    /// Loads the library at `library`. `threads` work within one graph; they do not spin when idle, so that other
    /// processes keep their cores.
    pub fn load(library: &Path, provider: Provider, threads: usize) -> Result<Self, RuntimeError> {
        if !(1..=MAX_THREADS).contains(&threads) {
            return Err(RuntimeError::Threads { found: threads });
        }
        let failed = |why: String| RuntimeError::Load { library: library.to_owned(), why };
        let path = library.canonicalize().map_err(|e| failed(e.to_string()))?;
        let mut loaded = LOADED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let environment = match &*loaded {
            Some((held, environment)) if *held == path => environment.clone(),
            Some((held, _)) => return Err(RuntimeError::AlreadyLoaded { asked: path, loaded: held.clone() }),
            None => {
                let builder = ort::init_from(&path).map_err(|e| failed(e.to_string()))?;
                let environment =
                    builder.with_name("nightfix").with_telemetry(false).build().map_err(|e| failed(e.to_string()))?;
                *loaded = Some((path.clone(), environment.clone()));
                environment
            }
        };
        tracing::info!(library = %path.display(), provider = provider.name(), threads, "ONNX Runtime");
        Ok(Self { environment, library: path, provider, threads })
    }

    /// The file that was loaded.
    pub fn library(&self) -> &Path {
        &self.library
    }

    /// The execution provider of all sessions.
    pub fn provider(&self) -> Provider {
        self.provider
    }

    /// Threads within one graph.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// A session for a graph held in memory: the bytes whose digest was checked are the bytes that run. A provider that
    /// is not available is an error, never a silent fall-back to the CPU.
    pub(super) fn session(&self, onnx: &[u8]) -> Result<Session, ort::Error> {
        let provider = match self.provider {
            Provider::Cpu => ep::CPU::default().build(),
            Provider::Cuda => ep::CUDA::default().build(),
            Provider::TensorRt => ep::TensorRT::default().build(),
            Provider::Xnnpack => ep::XNNPACK::default().build(),
        };
        Session::builder(&self.environment)?
            .with_intra_threads(self.threads)?
            .with_intra_op_spinning(false)?
            .with_execution_providers([provider.error_on_failure()])?
            .commit_from_memory(onnx)
    }
}

/// The library: `explicit` (`--onnxruntime`), else `configured` (`onnxruntime.library`), else the newest
/// `libonnxruntime.so*` beside the executable, else in `../lib/nightfix/` from there. One that is named and absent is an
/// error: no other is taken instead.
pub fn find_library(explicit: Option<&Path>, configured: Option<&Path>) -> Result<PathBuf, RuntimeError> {
    for (named, origin) in [(explicit, "--onnxruntime"), (configured, "onnxruntime.library")] {
        if let Some(path) = named {
            let found = path.is_file().then(|| path.to_owned());
            return found.ok_or_else(|| RuntimeError::NotFound { tried: format!("{} ({origin})", path.display()) });
        }
    }
    let beside = std::env::current_exe().and_then(|exe| exe.canonicalize()).ok();
    let beside = beside.as_deref().and_then(Path::parent).unwrap_or(Path::new("."));
    find_in(&[beside.to_owned(), beside.join("../lib/nightfix")])
}

/// The newest library in the first folder that has one.
fn find_in(folders: &[PathBuf]) -> Result<PathBuf, RuntimeError> {
    folders.iter().find_map(|folder| newest_library_in(folder)).ok_or_else(|| {
        let places: Vec<_> = folders.iter().map(|folder| format!("{}/libonnxruntime.so*", folder.display())).collect();
        let tried = format!("--onnxruntime (not given), onnxruntime.library (not set), {}", places.join(", "));
        RuntimeError::NotFound { tried }
    })
}

/// The `libonnxruntime.so*` with the highest version in a folder. `libonnxruntime_providers_*.so` do not count.
fn newest_library_in(folder: &Path) -> Option<PathBuf> {
    let version = |name: &str| -> Option<Vec<u64>> {
        let rest = name.strip_prefix("libonnxruntime.so")?;
        let mut parts = rest.split('.');
        parts.next().filter(|before_first_dot| before_first_dot.is_empty())?;
        parts.map(|part| part.parse().ok()).collect()
    };
    let entries = std::fs::read_dir(folder).ok()?.flatten();
    let named = entries.filter_map(|entry| Some((version(entry.file_name().to_str()?)?, entry.path())));
    named.filter(|(_, path)| path.is_file()).max_by(|a, b| a.0.cmp(&b.0)).map(|(_, path)| path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_library_is_taken_and_providers_are_not() {
        let folder = tempfile::tempdir().unwrap();
        for name in [
            "libonnxruntime.so.1.9.0",
            "libonnxruntime.so.1.31.1",
            "libonnxruntime_providers_shared.so",
            "libonnxruntime.so.old",
            "libonnxruntime.sox",
        ] {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        assert_eq!(newest_library_in(folder.path()).unwrap(), folder.path().join("libonnxruntime.so.1.31.1"));
    }

    #[test]
    fn a_named_library_that_is_absent_is_an_error_that_names_it() {
        let error = find_library(Some(Path::new("/no/such/lib.so")), None).unwrap_err().to_string();
        assert!(error.contains("/no/such/lib.so") && error.contains("--onnxruntime"), "{error}");
        let error = find_library(None, Some(Path::new("/no/such/either.so"))).unwrap_err().to_string();
        assert!(error.contains("/no/such/either.so") && error.contains("onnxruntime.library"), "{error}");
    }

    #[test]
    fn the_first_folder_with_a_library_wins_and_none_tells_all_places() {
        let (empty, full) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let folders = [empty.path().to_owned(), full.path().join("../lib/nightfix")];
        let error = find_in(&folders).unwrap_err().to_string();
        for place in ["--onnxruntime", "onnxruntime.library", "libonnxruntime.so*", "../lib/nightfix"] {
            assert!(error.contains(place), "{error}");
        }
        std::fs::write(full.path().join("libonnxruntime.so.1.30.0"), b"").unwrap();
        let found = find_in(&[empty.path().to_owned(), full.path().to_owned()]).unwrap();
        assert_eq!(found, full.path().join("libonnxruntime.so.1.30.0"));
    }

    #[test]
    fn a_file_that_is_no_library_is_a_clear_error() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let error = Runtime::load(file.path(), Provider::Cpu, 1).unwrap_err().to_string();
        assert!(error.contains("cannot be loaded") || error.contains("already loaded"), "{error}");
    }

    #[test]
    fn provider_names_round_trip_and_others_are_refused() {
        for provider in [Provider::Cpu, Provider::Cuda, Provider::TensorRt, Provider::Xnnpack] {
            assert_eq!(provider.name().parse::<Provider>().unwrap(), provider);
        }
        assert!("CPU".parse::<Provider>().unwrap_err().to_string().contains("cpu, cuda"));
    }
}
