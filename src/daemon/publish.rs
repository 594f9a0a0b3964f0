//! The publishing thread: answers go out in order, and never hold up localisation.

use super::health::{Health, now_ns};
use super::newest::{Newest, Popped};
use super::throttle::{Throttle, lock};
use crate::bus::{FixMessage, LastFixMessage};
use crate::locate::{Answer, NoFix, Reason};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Answers that may wait for a peer that is slow to take them: more than ten seconds of a fast camera.
const WAITING: usize = 256;

/// How often the thread turns with nothing to do.
const TURN: Duration = Duration::from_millis(200);

/// Answers on their way out, and the last one for those who ask.
#[derive(Debug)]
pub struct Outbox {
    waiting: Newest<FixMessage>,
    last: Mutex<(FixMessage, Instant)>,
}

impl Outbox {
    /// Nothing to send. Who asks is told that no prior was there yet: stamped with the start, message 0.
    pub fn new(health: &Health) -> Self {
        let detail = "frame: expected one, found none since the start";
        let none = Answer::bare(Err(NoFix::new(Reason::NoPrior, detail)), None);
        let identity = health.identity();
        let message = FixMessage::new(now_ns(), 0, &none, &identity.bundle, &identity.map);
        Self { waiting: Newest::new(WAITING), last: Mutex::new((message, Instant::now())) }
    }

    /// One more answer. Where too many wait the oldest gives way and is counted.
    pub fn push(&self, message: FixMessage, health: &Health) {
        *lock(&self.last) = (message.clone(), Instant::now());
        if self.waiting.push(message).is_some() {
            health.unpublished();
        }
    }

    /// The last answer and its age.
    pub fn last(&self) -> LastFixMessage {
        let last = lock(&self.last);
        LastFixMessage { message: last.0.clone(), age_ms: u64::try_from(last.1.elapsed().as_millis()).unwrap_or(u64::MAX) }
    }

    /// Nothing more will come.
    pub fn close(&self) {
        self.waiting.close();
    }
}

/// Sends answers until the outbox is closed and empty. `put` is the Zenoh publisher's, and may block; `after` is told of each
/// answer then.
pub fn publish_answers(
    outbox: &Outbox,
    health: &Health,
    put: impl Fn(Vec<u8>) -> Result<(), String>,
    mut after: impl FnMut(&FixMessage),
) {
    let throttle = Throttle::default();
    loop {
        health.beat(&health.publishing);
        let message = match outbox.waiting.pop(TURN) {
            Popped::Item(message) => message,
            Popped::Nothing => continue,
            Popped::Closed => return,
        };
        let sent = serde_json::to_vec(&message).map_err(|e| e.to_string()).and_then(&put);
        if let Err(why) = sent {
            health.unpublished();
            if let Some(silent) = throttle.open() {
                tracing::warn!(seq = message.seq, silent, "an answer could not be published: {why}");
            }
        }
        after(&message);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::{MapId, Status};
    use crate::daemon::health::Identity;

    fn health() -> Health {
        let map = MapId { name: "m.tif".into(), digest: "0".into() };
        let identity = Identity { vehicle: "uav".into(), bundle: "b".into(), map, provider: "cpu".into() };
        Health::new(identity, Duration::from_secs(1))
    }

    #[test]
    fn before_the_first_frame_there_is_no_prior() {
        let outbox = Outbox::new(&health());
        let value = serde_json::to_value(outbox.last()).unwrap();
        assert_eq!((&value["status"], &value["reason"], &value["seq"]), (&"no_fix".into(), &"no_prior".into(), &0.into()));
        assert!(value["age_ms"].as_u64().unwrap() < 60_000);
        for key in ["lat_deg", "lon_deg", "covariance_enu_m2", "radius95_m", "homography", "window", "prior"] {
            assert!(value.get(key).is_none(), "{key}: absent, not null");
        }
    }

    #[test]
    fn a_put_that_never_returns_holds_up_nobody_and_what_gives_way_is_counted() {
        let health = health();
        let outbox = Outbox::new(&health);
        let (enter, entered) = std::sync::mpsc::channel();
        let (leave, left) = std::sync::mpsc::channel::<()>();
        let left = Mutex::new(left);
        let sent = Mutex::new(Vec::new());
        std::thread::scope(|scope| {
            scope.spawn(|| {
                publish_answers(
                    &outbox,
                    &health,
                    |bytes| {
                        let _ = enter.send(());
                        let _ = lock(&left).recv();
                        lock(&sent).push(serde_json::from_slice::<FixMessage>(&bytes).unwrap().seq);
                        Ok(())
                    },
                    |_| (),
                )
            });
            let message = outbox.last().message;
            outbox.push(FixMessage { seq: 0, ..message.clone() }, &health);
            entered.recv().unwrap();
            for seq in 1..=WAITING as u64 + 10 {
                outbox.push(FixMessage { seq, ..message.clone() }, &health);
            }
            assert_eq!(health.status().answers_unpublished, 10);
            assert_eq!(outbox.last().message.seq, WAITING as u64 + 10);
            outbox.close();
            drop(leave);
        });
        let sent = sent.into_inner().unwrap();
        assert_eq!((sent.len(), sent[0], sent[1]), (WAITING + 1, 0, 11), "in order, the oldest gave way");
    }

    #[test]
    fn a_put_that_fails_is_counted() {
        let health = health();
        let outbox = Outbox::new(&health);
        let message = outbox.last().message;
        assert_eq!(message.status, Status::NoFix);
        outbox.push(message, &health);
        outbox.close();
        publish_answers(&outbox, &health, |_| Err("no".to_owned()), |_| ());
        assert_eq!(health.status().answers_unpublished, 1);
    }
}
