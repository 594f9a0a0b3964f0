//! A bounded queue in which the newest wins: what does not fit displaces the oldest, and the caller counts it.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The queue. With a capacity of one it is the slot of the newest frame.
#[derive(Debug)]
pub struct Newest<T> {
    capacity: usize,
    state: Mutex<State<T>>,
    /// Wakes the one who waits for an item.
    filled: Condvar,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    closed: bool,
}

/// What waiting for an item gives.
#[derive(Debug, PartialEq, Eq)]
pub enum Popped<T> {
    /// The oldest item.
    Item(T),
    /// Nothing came in time.
    Nothing,
    /// Nothing is left, and nothing will come.
    Closed,
}

impl<T> Newest<T> {
    /// An empty queue for at most `capacity` items (at least one).
    pub fn new(capacity: usize) -> Self {
        Self {
            capacity: capacity.max(1),
            state: Mutex::new(State { items: VecDeque::new(), closed: false }),
            filled: Condvar::new(),
        }
    }

    /// Adds an item; gives back what gave way to it: the oldest, or the item itself once closed.
    pub fn push(&self, item: T) -> Option<T> {
        let mut state = self.lock();
        if state.closed {
            return Some(item);
        }
        let displaced = if state.items.len() >= self.capacity { state.items.pop_front() } else { None };
        state.items.push_back(item);
        self.filled.notify_one();
        displaced
    }

    /// Adds an item only where there is room; else gives it back.
    pub fn push_if_room(&self, item: T) -> Option<T> {
        let mut state = self.lock();
        if state.closed || state.items.len() >= self.capacity {
            return Some(item);
        }
        state.items.push_back(item);
        self.filled.notify_one();
        None
    }

    /// Takes the oldest item, waiting for it at most `wait`.
    pub fn pop(&self, wait: Duration) -> Popped<T> {
        let until = Instant::now() + wait;
        let mut state = self.lock();
        loop {
            if let Some(item) = state.items.pop_front() {
                return Popped::Item(item);
            }
            if state.closed {
                return Popped::Closed;
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Popped::Nothing;
            }
            state = self.filled.wait_timeout(state, left).map_or_else(|poisoned| poisoned.into_inner().0, |(state, _)| state);
        }
    }

    /// Looks at the oldest item.
    pub fn oldest<R>(&self, look: impl FnOnce(&T) -> R) -> Option<R> {
        self.lock().items.front().map(look)
    }

    /// Nothing more comes in; what is there can still be taken.
    pub fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_all();
    }

    /// The lock. No code runs under it that could leave the state half changed, so a poisoned one is as good.
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::ZERO;

    #[test]
    fn the_newest_displaces_the_oldest() {
        let slot = Newest::new(1);
        assert_eq!(slot.push(1), None);
        assert_eq!(slot.push(2), Some(1));
        assert_eq!(slot.push_if_room(3), Some(3));
        assert_eq!(slot.oldest(|item| *item), Some(2));
        assert_eq!(slot.pop(NOW), Popped::Item(2));
        assert_eq!(slot.pop(NOW), Popped::Nothing);
        assert_eq!(slot.push_if_room(4), None);
        let queue = Newest::new(3);
        assert_eq!((0..5).filter_map(|i| queue.push(i)).collect::<Vec<_>>(), [0, 1]);
        assert_eq!((0..3).map(|_| queue.pop(NOW)).collect::<Vec<_>>(), [Popped::Item(2), Popped::Item(3), Popped::Item(4)]);
    }

    #[test]
    fn closing_lets_what_is_there_out_and_nothing_in() {
        let slot = Newest::new(1);
        slot.push(1);
        slot.close();
        assert_eq!(slot.push(2), Some(2));
        assert_eq!(slot.push_if_room(2), Some(2));
        assert_eq!(slot.pop(NOW), Popped::Item(1));
        assert_eq!(slot.pop(Duration::from_secs(60)), Popped::Closed);
    }

    #[test]
    fn one_who_waits_is_woken() {
        let slot = Newest::new(1);
        std::thread::scope(|scope| {
            let waiter = scope.spawn(|| slot.pop(Duration::from_secs(60)));
            std::thread::sleep(Duration::from_millis(20));
            slot.push(7);
            assert_eq!(waiter.join().unwrap(), Popped::Item(7));
            let waiter = scope.spawn(|| slot.pop(Duration::from_secs(60)));
            std::thread::sleep(Duration::from_millis(20));
            slot.close();
            assert_eq!(waiter.join().unwrap(), Popped::Closed);
        });
    }
}
