//! Which prior holds at a given exposure.

use crate::config::TrackSettings;
use crate::geo::LatLon;
use crate::locate::{Answer, NoFix, Prior};

/// How wide a reported prior is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Spread {
    /// 1-sigma per axis, metres.
    SigmaM(f64),
    /// A hard bound, metres.
    RadiusM(f64),
}

/// A prior as reported from outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PriorReport {
    /// When it held, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// Where.
    pub position: LatLon,
    /// How wide.
    pub spread: Spread,
    /// The sequence number of our fix that it echoes, where it does.
    pub fix_seq: Option<u64>,
}

/// Keeps the last external prior and the last own fix.
#[derive(Debug, Clone)]
pub struct Tracker {}

impl Tracker {
    /// Nothing known yet.
    pub fn new(settings: TrackSettings) -> Self {
        let _ = settings;
        todo!("track")
    }
    /// A prior came from outside.
    pub fn report(&mut self, prior: PriorReport) {
        let _ = prior;
        todo!("track")
    }
    /// The prior for a frame exposed at `stamp_ns`: own fix (sigma at least 50 m, grown by speed x age), or after 5
    /// "no fix" or 30 s the last external one, grown by its age.
    pub fn prior_at(&self, stamp_ns: i64) -> Result<Prior, NoFix> {
        let _ = stamp_ns;
        todo!("track")
    }
    /// An answer was given for a frame exposed at `stamp_ns`, with message number `seq`.
    pub fn record(&mut self, stamp_ns: i64, seq: u64, answer: &Answer) {
        let _ = (stamp_ns, seq, answer);
        todo!("track")
    }
}
