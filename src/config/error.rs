//! What can be wrong with a configuration.

use std::path::PathBuf;

/// What can be wrong with a configuration. `file` is the user's file; `place` is `line:column` in it, from 1.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("configuration `{file}`: {why}")]
    Read {
        /// The file.
        file: PathBuf,
        /// The cause.
        why: String,
    },
    /// Not TOML, an unknown key or a wrong type.
    #[error("configuration `{file}`:{line}:{column}: {message}")]
    Document {
        /// The file.
        file: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1, in characters.
        column: usize,
        /// The parser's words: what was expected and what was found.
        message: String,
    },
    /// A value that cannot be.
    #[error("configuration `{file}`:{place} {field}: expected {expected}, found {found}")]
    Value {
        /// The file.
        file: PathBuf,
        /// `line:column:` of the value, empty where the key is absent.
        place: String,
        /// Dotted key.
        field: String,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
}
