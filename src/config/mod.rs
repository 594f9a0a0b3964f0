//! The configuration. Every default stands once: in `config/nightfix.toml`, which is compiled in and on which a
//! user's file is laid, table by table. Unknown keys, wrong types and values out of range are errors that name the
//! user's file, line and column.

mod check;
mod error;
mod layers;
mod settings;

pub use check::MAX_SEARCH_RADIUS_M;
pub use error::ConfigError;
pub use layers::DEFAULTS;
pub use settings::{
    BudgetSettings, BundleSettings, DaemonSettings, EndpointSettings, GateSettings, MapSettings, OnnxRuntimeSettings,
    SearchSettings, Settings, TrackSettings, VehicleSettings, ZenohSettings,
};
