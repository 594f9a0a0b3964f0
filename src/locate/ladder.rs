//! The ladder: one [`Localizer`] per bundle. The window follows the prior: the smallest bundle whose D_C covers the search
//! disc answers (W_S = 512 m up to D_C = 64 m, 1024 m up to 256 m, 1536 m with a refine stage up to 512 m: STHN, Sec. V).
//! Beyond the largest D_C a region is searched where that is configured, else the prior is too wide.

use super::localizer::RADIUS_SLACK;
use super::search::Searcher;
use super::{Answer, Localizer, LocateError, Query, Reason, Seen};
use crate::config::{BudgetSettings, GateSettings, SearchSettings};
use crate::map::{GeoTiff, MapCache};
use crate::model::Bundle;

/// Bundles by D_C, over one map.
pub struct Ladder {
    /// All but the largest, by D_C.
    smaller: Vec<Localizer>,
    largest: Localizer,
    /// For priors wider than the largest D_C; none where no search is configured.
    searcher: Option<Searcher>,
}

impl Ladder {
    /// Puts one together. The map is digested once; `cache_bytes` of decoded tiles are shared out evenly.
    pub fn new(
        bundle: Bundle,
        further: Vec<Bundle>,
        map: &GeoTiff,
        cache_bytes: usize,
        gates: &GateSettings,
        budget: &BudgetSettings,
        search: &SearchSettings,
    ) -> Result<Self, LocateError> {
        map.digest()?;
        let share = cache_bytes / (1 + further.len());
        let localizer = |bundle| Localizer::new(bundle, MapCache::new(map.clone(), share), gates.clone(), budget.clone());
        let (mut smaller, mut largest) = (Vec::<Localizer>::new(), localizer(bundle)?);
        for bundle in further {
            let mut next = localizer(bundle)?;
            let name = |rung: &Localizer| rung.bundle().manifest.name.clone();
            if smaller.iter().chain([&largest]).any(|rung| name(rung) == name(&next)) {
                let expected = "a name of its own: messages tell the bundles of a ladder apart by it".into();
                return Err(LocateError::Bundle { bundle: name(&next), field: "name", expected, found: "another's".into() });
            }
            if next.search_radius_m() > largest.search_radius_m() {
                std::mem::swap(&mut next, &mut largest);
            }
            smaller.push(next);
        }
        smaller.sort_by(|a, b| a.search_radius_m().total_cmp(&b.search_radius_m()));
        let searcher = (search.max_radius_m > 0.0).then(|| Searcher::new(&mut largest, search.clone()));
        Ok(Self { smaller, largest, searcher })
    }

    /// Where was the vehicle? As [`Localizer::locate`], by the bundle that fits the prior.
    pub fn locate(&mut self, query: &Query<'_>) -> Answer {
        self.locate_within(query, &|| true).0
    }

    /// The same, and what was looked at. A search over a region goes on while `go_on` says so and is a `deadline` else:
    /// only the service has a clock.
    pub fn locate_within(&mut self, query: &Query<'_>, go_on: &dyn Fn() -> bool) -> (Answer, Seen) {
        let radius_m = query.prior.as_ref().ok().map(|prior| prior.radius_m);
        let circle = query.pose.yaw_deg.is_none() && self.rungs().any(Localizer::searches_circle);
        for rung in &mut self.smaller {
            let covers = radius_m.is_none_or(|r| r <= rung.search_radius_m() * (1.0 + RADIUS_SLACK));
            if !covers || (circle && !rung.searches_circle()) {
                continue;
            }
            let found = rung.locate_seen(query);
            // Too wide all the same: at the scale of a low frame. The next one is wider.
            if !is_too_wide(&found.0) {
                return found;
            }
        }
        let (mut answer, seen) = self.largest.locate_seen(query);
        let (true, Some(radius_m)) = (is_too_wide(&answer), radius_m) else { return (answer, seen) };
        let most_m = self.searcher.as_ref().map(Searcher::max_radius_m);
        if let (Some(searcher), true) = (&mut self.searcher, most_m.is_some_and(|most_m| radius_m <= most_m)) {
            return searcher.search(&mut self.largest, query, go_on);
        }
        if let Err(no_fix) = &mut answer.outcome {
            // The bundle's D_C holds the prior; what this low frame shows does not reach that far.
            if radius_m <= self.largest.search_radius_m() * (1.0 + RADIUS_SLACK) {
                no_fix.reason = Reason::FootprintTooSmall;
            }
            if let Some(most_m) = most_m {
                no_fix.detail = format!("{}; a search goes up to {most_m} m", no_fix.detail);
            }
        }
        (answer, seen)
    }

    /// The bundles, by D_C.
    pub fn rungs(&self) -> impl Iterator<Item = &Localizer> {
        self.smaller.iter().chain([&self.largest])
    }

    /// The one with the largest D_C.
    pub fn largest(&self) -> &Localizer {
        &self.largest
    }

    /// The one with the largest D_C alone.
    pub fn into_largest(self) -> Localizer {
        self.largest
    }

    /// The one of that name.
    pub fn rung(&self, name: &str) -> Option<&Localizer> {
        self.rungs().find(|rung| rung.bundle().manifest.name == name)
    }

    /// Names of the bundles, smallest first.
    pub fn name(&self) -> String {
        self.rungs().map(|rung| rung.bundle().manifest.name.as_str()).collect::<Vec<_>>().join(", ")
    }

    /// The map's file name and digest, for messages.
    pub fn map_id(&self) -> (String, String) {
        self.largest.map_id()
    }

    /// How a region is searched, for people.
    pub fn search_kind(&self) -> &'static str {
        self.searcher.as_ref().map_or("off", Searcher::kind)
    }

    /// How many tiles of map were encoded for searches so far.
    pub fn tiles_encoded(&self) -> u64 {
        self.searcher.as_ref().map_or(0, Searcher::tiles_encoded)
    }
}

fn is_too_wide(answer: &Answer) -> bool {
    matches!(&answer.outcome, Err(no_fix) if no_fix.reason == Reason::PriorTooWide)
}
