//! The last few stamped things, in the order in which they came.

use std::collections::VecDeque;

/// A stamp so long before that of the last to arrive is no disorder: the clock stepped back.
const STEP_NS: u64 = 1_000_000_000;

/// At most `capacity` stamped things; the oldest by arrival gives way. Arrival, not stamps, so that a clock that
/// stepped back cannot make the past immortal; and what is stamped later than a step's first stamp is forgotten.
#[derive(Debug, Clone)]
pub(crate) struct Recent<T> {
    capacity: usize,
    items: VecDeque<(i64, T)>,
}

impl<T> Recent<T> {
    /// Nothing yet.
    pub fn new(capacity: usize) -> Self {
        Self { capacity, items: VecDeque::new() }
    }

    /// Adds one.
    pub fn push(&mut self, stamp_ns: i64, item: T) {
        let last_ns = self.items.back().map_or(stamp_ns, |(at, _)| *at);
        if stamp_ns < last_ns && last_ns.abs_diff(stamp_ns) > STEP_NS {
            self.items.retain(|(at, _)| *at <= stamp_ns);
        }
        if self.items.len() >= self.capacity {
            self.items.pop_front();
        }
        self.items.push_back((stamp_ns, item));
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        self.items.clear();
    }

    /// The last to arrive first.
    pub fn newest_first(&self) -> impl Iterator<Item = (i64, &T)> {
        self.items.iter().rev().map(|(stamp_ns, item)| (*stamp_ns, item))
    }

    /// The one nearest in time, before or after; at a tie the last to arrive.
    pub fn nearest(&self, stamp_ns: i64) -> Option<(i64, &T)> {
        self.newest_first().min_by_key(|(at, _)| at.abs_diff(stamp_ns))
    }

    /// The nearest at or before, and the nearest at or after; at a tie the last to arrive.
    pub fn around(&self, stamp_ns: i64) -> (Option<(i64, &T)>, Option<(i64, &T)>) {
        let before = self.newest_first().filter(|(at, _)| *at <= stamp_ns).min_by_key(|(at, _)| at.abs_diff(stamp_ns));
        let after = self.newest_first().filter(|(at, _)| *at >= stamp_ns).min_by_key(|(at, _)| at.abs_diff(stamp_ns));
        (before, after)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_the_last_to_arrive() {
        let mut recent = Recent::new(2);
        recent.push(30, 'a');
        recent.push(10, 'b');
        recent.push(20, 'c');
        assert_eq!(recent.nearest(30), Some((20, &'c')));
        assert_eq!(recent.nearest(i64::MIN), Some((10, &'b')));
        assert_eq!(recent.around(15), (Some((10, &'b')), Some((20, &'c'))));
        assert_eq!(recent.around(5), (None, Some((10, &'b'))));
        assert_eq!(recent.around(25), (Some((20, &'c')), None));
        recent.push(20, 'd');
        assert_eq!(recent.nearest(20), Some((20, &'d')));
        assert_eq!(recent.around(20), (Some((20, &'d')), Some((20, &'d'))));
        recent.clear();
        assert_eq!(recent.nearest(20), None);
    }

    #[test]
    fn a_step_back_forgets_the_future_and_disorder_does_not() {
        const S: i64 = 1_000_000_000;
        let mut recent = Recent::new(8);
        for (stamp_ns, item) in [(7 * S, 'a'), (10 * S, 'b'), (9 * S, 'c')] {
            recent.push(stamp_ns, item);
        }
        assert_eq!(recent.nearest(10 * S), Some((10 * S, &'b')), "a second before is out of order");
        recent.push(8 * S - 1, 'd');
        assert_eq!(recent.nearest(10 * S), Some((8 * S - 1, &'d')), "more is a step");
        assert_eq!(recent.nearest(7 * S), Some((7 * S, &'a')));
        recent.push(i64::MAX, 'e');
        recent.push(i64::MIN, 'f');
        assert_eq!(recent.newest_first().collect::<Vec<_>>(), [(i64::MIN, &'f')]);
    }
}
