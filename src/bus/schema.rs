//! The JSON schemas of the messages, generated from the Rust types. `schemas/` holds them, checked by a test.

use super::{AttitudeMessage, FixMessage, FrameAttachment, PriorMessage, StatusMessage, TrackMessage};
use schemars::{JsonSchema, generate::SchemaSettings};

/// Names of the messages, and of the files in `schemas/`.
pub const SCHEMA_NAMES: [&str; 6] = ["attitude", "fix", "frame", "prior", "status", "track"];

/// The schema of a message, as the text of its file; `None` where there is no such message.
pub fn schema(name: &str) -> Option<String> {
    match name {
        "attitude" => Some(text::<AttitudeMessage>(true)),
        "fix" => Some(text::<FixMessage>(false)),
        "frame" => Some(text::<FrameAttachment>(true)),
        "prior" => Some(text::<PriorMessage>(true)),
        "status" => Some(text::<StatusMessage>(false)),
        "track" => Some(text::<TrackMessage>(false)),
        _ => None,
    }
}

/// What goes out is described as it is written (absent fields are absent, not null), what comes in as it is read.
fn text<T: JsonSchema>(comes_in: bool) -> String {
    let settings = SchemaSettings::draft2020_12();
    let settings = if comes_in { settings.for_deserialize() } else { settings.for_serialize() };
    let schema = settings.into_generator().into_root_schema_for::<T>();
    format!("{:#}\n", schema.as_value())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `NIGHTFIX_BLESS=1 cargo test --lib schema` writes them anew.
    #[test]
    fn checked_in_schemas_are_those_of_the_types() {
        for name in SCHEMA_NAMES {
            let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("schemas/{name}.json"));
            let text = schema(name).unwrap();
            if std::env::var_os("NIGHTFIX_BLESS").is_some() {
                std::fs::create_dir_all(file.parent().unwrap()).unwrap();
                std::fs::write(&file, &text).unwrap();
            }
            let found = std::fs::read_to_string(&file).unwrap_or_default();
            assert!(found == text, "{} differs from the types: run `NIGHTFIX_BLESS=1 cargo test --lib schema`", file.display());
        }
        assert_eq!(schema("frames"), None);
    }
}
