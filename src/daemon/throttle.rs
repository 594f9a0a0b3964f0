//! Logging what may come in floods, and taking locks.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// At most one line per second about one kind of event; the rest are counted.
#[derive(Debug, Default)]
pub struct Throttle(Mutex<(Option<Instant>, u64)>);

impl Throttle {
    /// Whether to log now: then how many events were kept silent since the last line.
    pub fn open(&self) -> Option<u64> {
        let mut state = lock(&self.0);
        let (last, silent) = &mut *state;
        if last.is_some_and(|at| at.elapsed() < Duration::from_secs(1)) {
            *silent += 1;
            return None;
        }
        *last = Some(Instant::now());
        Some(std::mem::take(silent))
    }
}

/// Takes a lock. What is under these locks is whole between any two statements, so a poisoned one is as good.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_one_line_and_a_count() {
        let throttle = Throttle::default();
        assert_eq!(throttle.open(), Some(0));
        assert_eq!((0..99).filter_map(|_| throttle.open()).count(), 0);
        lock(&throttle.0).0 = Instant::now().checked_sub(Duration::from_secs(2));
        assert_eq!(throttle.open(), Some(99));
    }
}
