//! The inference thread: one frame after the other, each answered exactly once.

use super::attitude::{Attitudes, camera_pose};
use super::health::Health;
use super::newest::{Newest, Popped};
use super::publish::Outbox;
use super::throttle::lock;
use crate::bus::FixMessage;
use crate::config::Settings;
use crate::locate::{Answer, EncodedFrame, NoFix, Query, Reason, tilt_was_assumed};
use crate::thermal::{Encoding, FrameError, Pose};
use crate::track::{Guard, Tracker};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// How often the thread turns with nothing to do.
const TURN: Duration = Duration::from_millis(200);

/// A frame that will be answered, unless a newer one displaces it first.
#[derive(Debug)]
pub struct Job {
    /// Exposure, Unix UTC nanoseconds.
    pub stamp_ns: i64,
    /// When it came in, by a clock that does not step: its deadline counts from here.
    pub arrived: Instant,
    /// Its bytes, or why it cannot be read.
    pub frame: Result<FrameBytes, FrameError>,
    /// The camera's pose, as far as the frame states it.
    pub stated: Pose,
}

/// A frame's bytes and how to read them.
#[derive(Debug)]
pub struct FrameBytes {
    /// The bytes.
    pub bytes: Vec<u8>,
    /// How to read them.
    pub encoding: Encoding,
    /// Width and height, pixels.
    pub size_px: (u32, u32),
}

/// What the inference thread shares with the callbacks that feed it.
#[derive(Debug)]
pub struct Inbox {
    /// The slot of the newest frame.
    pub frames: Newest<Job>,
    /// Priors.
    pub tracker: Mutex<Tracker>,
    /// Attitudes.
    pub attitudes: Mutex<Attitudes>,
}

impl Inbox {
    /// Empty.
    pub fn new(tracker: Tracker, attitudes: Attitudes) -> Self {
        Self { frames: Newest::new(1), tracker: Mutex::new(tracker), attitudes: Mutex::new(attitudes) }
    }
}

/// Answers frames until the slot is closed and empty. `locate` is [`crate::locate::Ladder::locate_within`]; what it finds goes
/// past the `guard` before anything else learns of it.
pub fn answer_frames(
    inbox: &Inbox,
    outbox: &Outbox,
    health: &Health,
    settings: &Settings,
    deadline: Duration,
    mut guard: Guard,
    mut locate: impl FnMut(&Query<'_>) -> Answer,
) {
    let identity = health.identity().clone();
    // 0 is what the queryable answers before the first frame.
    let mut seq = 1;
    loop {
        health.beat(&health.inference);
        let job = match inbox.frames.pop(TURN) {
            Popped::Item(job) => job,
            Popped::Nothing => continue,
            Popped::Closed => return,
        };
        health.begin(job.arrived);
        let mut answer = answer(inbox, &job, settings, deadline, &mut locate);
        let external = lock(&inbox.tracker).external_at(job.stamp_ns);
        let bytes = job.frame.as_ref().ok().map(|frame| frame.bytes.as_slice());
        guard.judge(job.stamp_ns, bytes, external.as_ref(), &mut answer);
        lock(&inbox.tracker).record(job.stamp_ns, seq, &answer);
        let reason = answer.outcome.as_ref().err().map(|no_fix| no_fix.reason);
        outbox.push(FixMessage::new(job.stamp_ns, seq, &answer, &identity.bundle, &identity.map), health);
        health.answered(job.stamp_ns, reason, job.arrived.elapsed());
        seq += 1;
    }
}

/// Answers one frame, in time or not at all.
fn answer(
    inbox: &Inbox,
    job: &Job,
    settings: &Settings,
    deadline: Duration,
    locate: &mut impl FnMut(&Query<'_>) -> Answer,
) -> Answer {
    let waited = job.arrived.elapsed();
    let prior = lock(&inbox.tracker).prior_at(job.stamp_ns);
    let vehicle = lock(&inbox.attitudes).at(job.stamp_ns);
    let query = Query {
        stamp_ns: job.stamp_ns,
        frame: job.frame.as_ref().map_err(Clone::clone).map(|frame| EncodedFrame {
            bytes: &frame.bytes,
            encoding: frame.encoding,
            size_px: Some(frame.size_px),
        }),
        pose: camera_pose(&job.stated, vehicle.as_ref(), &settings.camera),
        prior,
    };
    let mut answer = if waited > deadline {
        // Too late already: the time is better spent on the next frame. An earlier reason goes first.
        let no_fix = query.prior.as_ref().err().cloned().unwrap_or_else(|| late(waited, deadline));
        Answer::bare(Err(no_fix), query.prior.ok())
    } else {
        locate(&query)
    };
    if !(job.stated.tilt_known() || vehicle.is_some_and(|vehicle| vehicle.tilt_known())) {
        tilt_was_assumed(&settings.budget, &mut answer);
    }
    let took = job.arrived.elapsed();
    if answer.outcome.is_ok() && took > deadline {
        answer.outcome = Err(late(took, deadline));
    }
    answer.latency_ms.insert("wait".to_owned(), waited.as_secs_f64() * 1e3);
    answer
}

fn late(took: Duration, deadline: Duration) -> NoFix {
    let detail = format!("frame: expected an answer within {} ms, found {} ms", deadline.as_millis(), took.as_millis());
    NoFix { reason: Reason::Deadline, detail }
}

#[cfg(test)]
#[path = "answer_tests.rs"]
mod tests;
