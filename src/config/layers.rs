//! The default document, and a user's file laid on it.

use super::{ConfigError, Settings};
use serde::Deserialize;
use std::io::Read;
use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// The default document: every option, explained.
pub const DEFAULTS: &str = include_str!("../../config/nightfix.toml");

/// Largest configuration file that is read, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

impl Settings {
    /// The defaults alone.
    pub fn defaults() -> Result<Self, ConfigError> {
        Self::from_toml("", Path::new("nightfix.toml"))
    }

    /// Reads a user's file, lays it on the defaults and checks it. Relative paths in it are taken from its folder.
    pub fn load(file: &Path) -> Result<Self, ConfigError> {
        let read = |why: String| ConfigError::Read { file: file.to_owned(), why };
        let handle = std::fs::File::open(file).map_err(|e| read(e.to_string()))?;
        let mut bytes = Vec::new();
        handle.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes).map_err(|e| read(e.to_string()))?;
        if bytes.len() as u64 > MAX_FILE_BYTES {
            return Err(read(format!("expected at most {MAX_FILE_BYTES} bytes, found more")));
        }
        let text = String::from_utf8(bytes).map_err(|e| read(format!("expected UTF-8, found {}", e.utf8_error())))?;
        Self::from_toml(&text, file)
    }

    /// The same for a text; `file` names it in errors, and its folder is where relative paths start.
    pub fn from_toml(text: &str, file: &Path) -> Result<Self, ConfigError> {
        let document = |error: &toml::de::Error| {
            let (line, column) = line_column(text, error.span().map_or(0, |s| s.start));
            ConfigError::Document { file: file.to_owned(), line, column, message: error.message().to_owned() }
        };
        let user = DeTable::parse(text).map_err(|e| document(&e))?;
        // The defaults are ours and tested: an error in them would be reported with the wrong place, but cannot occur.
        let mut merged = DeTable::parse(DEFAULTS).map_err(|e| document(&e))?;
        lay(merged.get_mut(), user.get_ref());
        let mut settings = Self::deserialize(toml::Deserializer::from(merged)).map_err(|e| document(&e))?;
        settings.check(&Source { file, text, table: user.get_ref() })?;
        let folder = file.parent().unwrap_or(Path::new(""));
        for path in [
            &mut settings.map.path,
            &mut settings.bundle.path,
            &mut settings.onnxruntime.library,
            &mut settings.zenoh.config_file,
        ]
        .into_iter()
        .flatten()
        .chain(&mut settings.bundle.ladder)
        {
            *path = folder.join(&*path);
        }
        Ok(settings)
    }
}

/// Lays `over` on `base`: tables are merged, everything else is replaced. Spans stay those of where a thing stood.
fn lay<'a>(base: &mut DeTable<'a>, over: &DeTable<'a>) {
    for (key, value) in over {
        if let (DeValue::Table(over), Some(DeValue::Table(base))) =
            (value.get_ref(), base.get_mut(key.get_ref().as_ref()).map(Spanned::get_mut))
        {
            lay(base, over);
            continue;
        }
        // Removed first, so that the user's key, not the default's, is the one an error points to.
        base.remove(key.get_ref().as_ref());
        base.insert(key.clone(), value.clone());
    }
}

/// Where values came from, for errors.
pub(super) struct Source<'a> {
    pub(super) file: &'a Path,
    text: &'a str,
    table: &'a DeTable<'a>,
}

impl Source<'_> {
    /// An error about the value of a dotted key.
    pub(super) fn error(&self, field: &str, expected: impl Into<String>, found: impl ToString) -> ConfigError {
        let place = self.find(field).map_or_else(String::new, |offset| {
            let (line, column) = line_column(self.text, offset);
            format!("{line}:{column}:")
        });
        ConfigError::Value {
            file: PathBuf::from(self.file),
            place,
            field: field.to_owned(),
            expected: expected.into(),
            found: found.to_string(),
        }
    }

    /// Byte offset of the value of a dotted key, where the user's file states it.
    fn find(&self, field: &str) -> Option<usize> {
        let mut table = self.table;
        let mut offset = None;
        for key in field.split('.') {
            let value = table.get(key)?;
            offset = Some(value.span().start);
            if let DeValue::Table(inner) = value.get_ref() {
                table = inner;
            }
        }
        offset
    }
}

/// Line and column, from 1, of a byte offset.
fn line_column(text: &str, offset: usize) -> (usize, usize) {
    let before = text.get(..offset).unwrap_or(text);
    let line = before.matches('\n').count() + 1;
    let column = before.rsplit('\n').next().unwrap_or("").chars().count() + 1;
    (line, column)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// The default document with its commented keys switched on.
    fn every_key() -> String {
        DEFAULTS
            .lines()
            .map(|line| match line.strip_prefix("# ") {
                Some(rest) if rest.split_once(" = ").is_some_and(|(key, _)| !key.contains([' ', ':'])) => rest.to_owned(),
                _ => line.to_owned(),
            })
            .collect::<Vec<_>>()
            .join("\n")
    }

    fn flatten(prefix: &str, value: &serde_json::Value, into: &mut BTreeSet<String>) {
        match value {
            serde_json::Value::Object(map) => {
                for (key, value) in map {
                    let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                    flatten(&path, value, into);
                }
            }
            _ => {
                into.insert(prefix.to_owned());
            }
        }
    }

    fn keys(value: &impl serde::Serialize) -> BTreeSet<String> {
        let mut into = BTreeSet::new();
        flatten("", &serde_json::to_value(value).unwrap(), &mut into);
        into
    }

    #[test]
    fn default_document_states_every_setting_and_nothing_else() {
        let document: toml::Table = toml::from_str(&every_key()).unwrap();
        assert_eq!(keys(&document), keys(&Settings::defaults().unwrap()));
    }

    #[test]
    fn defaults_are_those_of_the_document() {
        let document: serde_json::Value = serde_json::to_value(toml::from_str::<toml::Table>(DEFAULTS).unwrap()).unwrap();
        let mut settings = serde_json::to_value(Settings::defaults().unwrap()).unwrap();
        for (_, section) in settings.as_object_mut().unwrap() {
            section.as_object_mut().unwrap().retain(|_, value| !value.is_null());
        }
        assert_eq!(settings, document);
    }

    #[test]
    fn commented_keys_are_valid_as_they_stand() {
        let settings = Settings::from_toml(&every_key(), Path::new("/etc/nightfix/nightfix.toml")).unwrap();
        assert_eq!(settings.map.path.as_deref(), Some(Path::new("/etc/nightfix/map.tif")));
        assert_eq!(settings.onnxruntime.library.as_deref(), Some(Path::new("/usr/lib/libonnxruntime.so")));
        assert_eq!(settings.zenoh.config_file.as_deref(), Some(Path::new("/etc/nightfix/zenoh.json5")));
        assert_eq!(settings.camera.hfov_deg, Some(32.0));
    }

    #[test]
    fn a_users_file_states_only_what_differs() {
        let text = "[track]\nmax_speed_mps = 40\n[zenoh]\nconnect.endpoints = [\"tcp/127.0.0.1:7447\"]\n";
        let settings = Settings::from_toml(text, Path::new("a.toml")).unwrap();
        let defaults = Settings::defaults().unwrap();
        assert_eq!(settings.track.max_speed_mps, 40.0);
        assert_eq!(settings.track.own_fix_sigma_m, defaults.track.own_fix_sigma_m);
        assert_eq!(settings.zenoh.connect.endpoints, ["tcp/127.0.0.1:7447"]);
        assert!(settings.zenoh.listen.endpoints.is_empty());
        assert_eq!(settings.gates, defaults.gates);
    }

    fn error(text: &str) -> String {
        Settings::from_toml(text, Path::new("dir/a.toml")).unwrap_err().to_string()
    }

    #[test]
    fn errors_name_file_line_and_column() {
        let text = error("[track]\nmax_speed_mps = 30.0\nmax_sped_mps = 4\n");
        assert!(text.starts_with("configuration `dir/a.toml`:3:1: unknown field `max_sped_mps`"), "{text}");
        let text = error("\n[trak]\n");
        assert!(text.starts_with("configuration `dir/a.toml`:2:"), "{text}");
        assert!(text.contains("unknown field `trak`"), "{text}");
        let text = error("[daemon]\n  deadline_ms = \"soon\"\n");
        assert!(text.starts_with("configuration `dir/a.toml`:2:17: invalid type: string \"soon\", expected u64"), "{text}");
        let text = error("[daemon]\ndeadline_ms = -5\n");
        assert!(text.starts_with("configuration `dir/a.toml`:2:15: "), "{text}");
        let text = error("[daemon\n");
        assert!(text.starts_with("configuration `dir/a.toml`:1:"), "{text}");
        let text = error("[daemon]\ndeadline_ms = 5\ndeadline_ms = 5\n");
        assert!(text.starts_with("configuration `dir/a.toml`:3:"), "{text}");
        let text = error("daemon = 3\n");
        assert!(text.starts_with("configuration `dir/a.toml`:1:10: "), "{text}");
        let text = error("[zenoh.listen]\nendpoint = []\n");
        assert!(text.starts_with("configuration `dir/a.toml`:2:1: unknown field `endpoint`"), "{text}");
    }

    #[test]
    fn values_out_of_range_name_field_expected_and_found() {
        let text = error("[track]\nmax_speed_mps = -1\n");
        assert_eq!(text, "configuration `dir/a.toml`:2:17: track.max_speed_mps: expected more than 0 and at most 1000, found -1");
        let text = error("[vehicle]\nname = \"a/b\"\n");
        assert!(text.starts_with("configuration `dir/a.toml`:2:8: vehicle.name: expected "), "{text}");
        assert!(text.ends_with("found `a/b`"), "{text}");
    }

    #[test]
    fn examples_are_valid() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/examples");
        let files: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().flatten().map(|file| file.path()).collect();
        let mut examples = 0;
        for file in files.iter().filter(|file| file.extension().is_some_and(|e| e == "toml")) {
            let settings = Settings::load(file).unwrap();
            crate::bus::zenoh_config(&settings.zenoh, 1 << 20).unwrap();
            examples += 1;
        }
        assert_eq!(examples, 2);
    }

    #[test]
    fn files_that_cannot_be_read_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("missing.toml");
        assert!(Settings::load(&missing).unwrap_err().to_string().contains("missing.toml"));
        let latin = folder.path().join("latin.toml");
        std::fs::write(&latin, b"[vehicle]\nname = \"\xe9\"\n").unwrap();
        assert!(Settings::load(&latin).unwrap_err().to_string().contains("UTF-8"));
        let huge = folder.path().join("huge.toml");
        std::fs::write(&huge, vec![b'#'; (MAX_FILE_BYTES + 2) as usize]).unwrap();
        assert!(Settings::load(&huge).unwrap_err().to_string().contains("at most"));
    }
}
