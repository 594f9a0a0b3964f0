//! Key expressions: `nightfix/v1/<vehicle>/...`.

/// The keys of one vehicle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    root: String,
}

impl Keys {
    /// Keys of a vehicle (checked by the configuration to be one plain chunk).
    pub fn new(vehicle: &str) -> Self {
        Self { root: format!("nightfix/v1/{vehicle}") }
    }
    /// Out: fixes; a queryable answers with the last one.
    pub fn fix(&self) -> String {
        format!("{}/fix", self.root)
    }
    /// Out: health, 1 Hz and on change.
    pub fn status(&self) -> String {
        format!("{}/status", self.root)
    }
    /// Out: liveliness token.
    pub fn alive(&self) -> String {
        format!("{}/alive", self.root)
    }
    /// Out, where it is asked for: the smoothed track.
    pub fn track(&self) -> String {
        format!("{}/track", self.root)
    }
    /// In: frames.
    pub fn frame(&self) -> String {
        format!("{}/frame", self.root)
    }
    /// In: priors.
    pub fn prior(&self) -> String {
        format!("{}/prior", self.root)
    }
    /// In: attitudes.
    pub fn attitude(&self) -> String {
        format!("{}/attitude", self.root)
    }
}
