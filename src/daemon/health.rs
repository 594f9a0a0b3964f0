//! What the service counts, whether it is well, and what it says about both.

use super::throttle::lock;
use crate::bus::{FrameCounts, InputCounts, MapId, State, Status, StatusMessage};
use crate::locate::Reason;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::sync::Notify;

/// A loop that has not turned for this long is stuck. Every loop turns several times a second with nothing to do; the
/// longest honest wait is Zenoh's for a peer whose queue is full, one second.
const STUCK_AFTER: Duration = Duration::from_secs(5);

/// Without a frame for this long the service is idle.
const IDLE_AFTER: Duration = Duration::from_secs(5);

/// What does not change while the service runs.
#[derive(Debug, Clone)]
pub struct Identity {
    /// Vehicle name.
    pub vehicle: String,
    /// Bundle name.
    pub bundle: String,
    /// The map.
    pub map: MapId,
    /// Execution provider.
    pub provider: String,
}

/// Counters and pulses, shared by all threads.
#[derive(Debug)]
pub struct Health {
    identity: Identity,
    started: Instant,
    deadline: Duration,
    counts: Mutex<Counts>,
    /// Arrival of the frame being answered.
    busy: Mutex<Option<Instant>>,
    /// The inference thread.
    pub inference: Pulse,
    /// The publishing thread.
    pub publishing: Pulse,
    /// Wakes whoever publishes the status: something changed.
    pub changed: Notify,
}

#[derive(Debug, Default)]
struct Counts {
    frames: FrameCounts,
    fixes: u64,
    no_fix: BTreeMap<Reason, u64>,
    unpublished: u64,
    priors: InputCounts,
    attitudes: InputCounts,
    last_arrival: Option<Instant>,
    last: Option<(i64, Status, f64)>,
    stopping: bool,
}

/// When a loop last turned.
#[derive(Debug, Default)]
pub struct Pulse(AtomicU64);

impl Pulse {
    fn beat(&self, started: Instant) {
        self.0.store(started.elapsed().as_millis() as u64, Relaxed);
    }
    fn age(&self, started: Instant) -> Duration {
        started.elapsed().saturating_sub(Duration::from_millis(self.0.load(Relaxed)))
    }
}

impl Health {
    /// All well, nothing counted.
    pub fn new(identity: Identity, deadline: Duration) -> Self {
        Self {
            identity,
            started: Instant::now(),
            deadline,
            counts: Mutex::default(),
            busy: Mutex::default(),
            inference: Pulse::default(),
            publishing: Pulse::default(),
            changed: Notify::new(),
        }
    }

    /// What does not change.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// A loop turned.
    pub fn beat(&self, pulse: &Pulse) {
        pulse.beat(self.started);
    }

    /// A frame came in: will it be answered?
    pub fn frame_received(&self, accepted: bool) {
        let mut counts = lock(&self.counts);
        counts.frames.received += 1;
        if accepted {
            counts.frames.accepted += 1;
            counts.last_arrival = Some(Instant::now());
        } else {
            counts.frames.bad += 1;
        }
        drop(counts);
        self.changed.notify_one();
    }

    /// An accepted frame gave way to a newer one.
    pub fn frame_dropped(&self) {
        lock(&self.counts).frames.dropped += 1;
    }

    /// A prior came in: was it taken?
    pub fn prior_received(&self, taken: bool) {
        count(&mut lock(&self.counts).priors, taken);
    }

    /// An attitude came in: was it taken?
    pub fn attitude_received(&self, taken: bool) {
        count(&mut lock(&self.counts).attitudes, taken);
    }

    /// Work on a frame that arrived then begins.
    pub fn begin(&self, arrived: Instant) {
        *lock(&self.busy) = Some(arrived);
    }

    /// A frame was answered: a fix, or the reason for none.
    pub fn answered(&self, stamp_ns: i64, reason: Option<Reason>, latency: Duration) {
        *lock(&self.busy) = None;
        self.beat(&self.inference);
        let mut counts = lock(&self.counts);
        let status = match reason {
            None => {
                counts.fixes += 1;
                Status::Fix
            }
            Some(reason) => {
                *counts.no_fix.entry(reason).or_default() += 1;
                Status::NoFix
            }
        };
        counts.last = Some((stamp_ns, status, latency.as_secs_f64() * 1e3));
        drop(counts);
        self.changed.notify_one();
    }

    /// An answer gave way to newer ones before it could be published.
    pub fn unpublished(&self) {
        lock(&self.counts).unpublished += 1;
    }

    /// On the way out.
    pub fn stopping(&self) {
        lock(&self.counts).stopping = true;
    }

    /// Why the service is not well, if it is not. `waiting_since`: arrival of the oldest frame not yet begun.
    pub fn fault(&self, waiting_since: Option<Instant>) -> Option<String> {
        let busy = *lock(&self.busy);
        let oldest = busy.into_iter().chain(waiting_since).min().map(|arrived| arrived.elapsed());
        if let Some(age) = oldest.filter(|age| *age > self.deadline) {
            return Some(format!("a frame waits for {} ms, its deadline is {} ms", age.as_millis(), self.deadline.as_millis()));
        }
        let stuck = |name: &str, pulse: &Pulse| {
            let age = pulse.age(self.started);
            (age > STUCK_AFTER).then(|| format!("the {name} thread has not turned for {} ms", age.as_millis()))
        };
        let inference = if busy.is_some() { None } else { stuck("inference", &self.inference) };
        inference.or_else(|| stuck("publishing", &self.publishing))
    }

    /// What the service is doing.
    pub fn state(&self) -> State {
        let counts = lock(&self.counts);
        let idle = counts.last_arrival.is_none_or(|at| at.elapsed() > IDLE_AFTER);
        match counts.last {
            _ if counts.stopping => State::Stopping,
            _ if idle => State::Idle,
            Some((_, Status::Fix, _)) => State::Fix,
            _ => State::NoFix,
        }
    }

    /// The status message, now.
    pub fn status(&self) -> StatusMessage {
        let state = self.state();
        let counts = lock(&self.counts);
        StatusMessage {
            stamp_ns: now_ns(),
            vehicle: self.identity.vehicle.clone(),
            state,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            uptime_s: self.started.elapsed().as_secs_f64(),
            bundle: self.identity.bundle.clone(),
            map: self.identity.map.clone(),
            provider: self.identity.provider.clone(),
            frames: counts.frames,
            fixes: counts.fixes,
            no_fix: counts.no_fix.clone(),
            answers_unpublished: counts.unpublished,
            priors: counts.priors,
            attitudes: counts.attitudes,
            last_stamp_ns: counts.last.map(|(stamp_ns, _, _)| stamp_ns),
            last_status: counts.last.map(|(_, status, _)| status),
            last_latency_ms: counts.last.map(|(_, _, ms)| ms),
        }
    }
}

fn count(counts: &mut InputCounts, taken: bool) {
    counts.received += 1;
    counts.bad += u64::from(!taken);
}

/// This machine's clock, Unix UTC nanoseconds; 0 before 1970.
pub fn now_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| i64::try_from(since.as_nanos()).unwrap_or(i64::MAX))
}

/// One line about a status, for the service manager.
pub fn summary(status: &StatusMessage) -> String {
    let state = match status.state {
        State::Idle => "idle: no frames",
        State::Fix => "fix",
        State::NoFix => "no fix",
        State::Stopping => "stopping",
    };
    let no_fix: u64 = status.no_fix.values().sum();
    let FrameCounts { received, dropped, bad, .. } = status.frames;
    format!("{state}; {} fixes, {no_fix} no fix; frames: {received} received, {dropped} dropped, {bad} bad", status.fixes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn health(deadline_ms: u64) -> Health {
        let identity = Identity {
            vehicle: "uav".into(),
            bundle: "b".into(),
            map: MapId { name: "m.tif".into(), digest: "0".into() },
            provider: "cpu".into(),
        };
        Health::new(identity, Duration::from_millis(deadline_ms))
    }

    #[test]
    fn a_frame_past_its_deadline_is_a_fault_until_it_is_answered() {
        let health = health(30);
        assert_eq!(health.fault(None), None);
        let arrived = Instant::now();
        health.begin(arrived);
        assert_eq!(health.fault(None), None);
        std::thread::sleep(Duration::from_millis(40));
        assert!(health.fault(None).unwrap().contains("deadline is 30 ms"));
        health.answered(1, Some(Reason::Deadline), arrived.elapsed());
        assert_eq!(health.fault(None), None);
        assert!(health.fault(Some(arrived)).is_some(), "a waiting frame counts as well");
    }

    #[test]
    fn a_loop_that_stands_still_is_a_fault() {
        let mut health = health(1000);
        health.started = Instant::now().checked_sub(STUCK_AFTER * 2).unwrap();
        assert!(health.fault(None).unwrap().contains("inference"));
        health.beat(&health.inference);
        assert!(health.fault(None).unwrap().contains("publishing"));
        health.beat(&health.publishing);
        assert_eq!(health.fault(None), None);
    }

    #[test]
    fn counts_add_up_and_states_follow() {
        let health = health(1000);
        assert_eq!(health.state(), State::Idle);
        health.frame_received(false);
        assert_eq!(health.state(), State::Idle, "a frame that cannot be answered is no frame");
        health.frame_received(true);
        assert_eq!(health.state(), State::NoFix);
        health.frame_received(true);
        health.frame_dropped();
        health.answered(5, None, Duration::from_millis(3));
        assert_eq!(health.state(), State::Fix);
        health.frame_received(true);
        health.answered(6, Some(Reason::OffMap), Duration::from_millis(3));
        health.prior_received(true);
        health.prior_received(false);
        let status = health.status();
        assert_eq!(status.frames, FrameCounts { received: 4, accepted: 3, dropped: 1, bad: 1 });
        assert_eq!((status.fixes, status.no_fix[&Reason::OffMap]), (1, 1));
        assert_eq!(status.frames.accepted, status.fixes + status.no_fix.values().sum::<u64>() + status.frames.dropped);
        assert_eq!(status.priors, InputCounts { received: 2, bad: 1 });
        assert_eq!((status.state, status.last_stamp_ns, status.last_status), (State::NoFix, Some(6), Some(Status::NoFix)));
        health.stopping();
        assert_eq!(health.state(), State::Stopping);
        assert!(summary(&health.status()).starts_with("stopping; 1 fixes, 1 no fix"));
    }
}
