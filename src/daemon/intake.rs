//! What comes in: frames, priors, attitudes. Untrusted. These run on Zenoh's receiving thread, so they only check, copy
//! and put down; what comes from one peer is put down in the order in which it was sent (a prior before its frame).

use super::answer::{FrameBytes, Inbox, Job};
use super::health::Health;
use super::throttle::{Throttle, lock};
use crate::bus::{AttitudeMessage, FrameAttachment, InputError, MAX_MESSAGE_BYTES, PriorMessage};
use crate::thermal::{FrameError, Pose};
use std::borrow::Cow;
use std::sync::Arc;
use std::time::Instant;
use zenoh::bytes::ZBytes;
use zenoh::sample::Sample;

/// Takes what comes in.
pub struct Intake {
    inbox: Arc<Inbox>,
    health: Arc<Health>,
    max_frame_bytes: usize,
    refused: Throttle,
}

impl Intake {
    /// Puts things down in `inbox`.
    pub fn new(inbox: Arc<Inbox>, health: Arc<Health>, max_frame_bytes: usize) -> Self {
        Self { inbox, health, max_frame_bytes, refused: Throttle::default() }
    }

    /// A frame.
    pub fn frame(&self, sample: &Sample) {
        let attachment = sample.attachment().map(bounded).unwrap_or_default();
        self.take_frame(&attachment, sample.payload().len(), || sample.payload().to_bytes().into_owned());
    }

    /// A frame, apart from Zenoh: its attachment, its payload's length, and how to copy the payload.
    fn take_frame(&self, attachment: &[u8], payload_bytes: usize, copy: impl FnOnce() -> Vec<u8>) {
        let arrived = Instant::now();
        let (stamp_ns, job) = match self.check_frame(attachment, payload_bytes) {
            Ok(message) => {
                let frame = FrameBytes { bytes: copy(), encoding: message.encoding, size_px: (message.width, message.height) };
                (Some(message.stamp_ns), Job { stamp_ns: message.stamp_ns, arrived, stated: message.pose(), frame: Ok(frame) })
            }
            Err(error) => {
                self.log(&error);
                let stamp_ns = FrameAttachment::stamp_of_refused(attachment);
                let frame = Err(FrameError::Field {
                    field: "message",
                    expected: error.expected,
                    found: format!("{}: {}", error.field, error.found),
                });
                (stamp_ns, Job { stamp_ns: stamp_ns.unwrap_or_default(), arrived, stated: Pose::default(), frame })
            }
        };
        self.health.frame_received(stamp_ns.is_some());
        if stamp_ns.is_none() {
            return;
        }
        // A frame that is only to be refused does not displace one that may give a fix.
        let displaced = match &job.frame {
            Ok(_) => self.inbox.frames.push(job),
            Err(_) => self.inbox.frames.push_if_room(job),
        };
        if displaced.is_some() {
            self.health.frame_dropped();
        }
    }

    fn check_frame(&self, attachment: &[u8], payload_bytes: usize) -> Result<FrameAttachment, InputError> {
        let message = FrameAttachment::parse(attachment)?;
        if payload_bytes > self.max_frame_bytes {
            return Err(InputError {
                what: "frame",
                field: "payload".to_owned(),
                expected: format!("at most {} bytes", self.max_frame_bytes),
                found: format!("{payload_bytes} bytes"),
            });
        }
        Ok(message)
    }

    /// A prior.
    pub fn prior(&self, payload: &ZBytes) {
        let taken = match PriorMessage::parse(&bounded(payload)).and_then(|message| message.report()) {
            Ok(report) => lock(&self.inbox.tracker).report(report),
            Err(error) => {
                self.log(&error);
                false
            }
        };
        self.health.prior_received(taken);
    }

    /// An attitude.
    pub fn attitude(&self, payload: &ZBytes) {
        let message = AttitudeMessage::parse(&bounded(payload));
        self.health.attitude_received(message.is_ok());
        match message {
            Ok(message) => lock(&self.inbox.attitudes).push(message),
            Err(error) => self.log(&error),
        }
    }

    fn log(&self, error: &InputError) {
        if let Some(silent) = self.refused.open() {
            tracing::warn!(silent, "refused: {error}");
        }
    }
}

/// The bytes of a small message; of one that is too large, just enough to tell, so that nothing large is copied.
fn bounded(bytes: &ZBytes) -> Cow<'_, [u8]> {
    if bytes.len() <= MAX_MESSAGE_BYTES { bytes.to_bytes() } else { Cow::Owned(vec![b' '; MAX_MESSAGE_BYTES + 1]) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::{FrameCounts, InputCounts, MapId};
    use crate::config::Settings;
    use crate::daemon::attitude::Attitudes;
    use crate::daemon::health::Identity;
    use crate::daemon::newest::Popped;
    use crate::track::Tracker;
    use std::time::Duration;

    fn intake() -> Intake {
        let map = MapId { name: "m.tif".into(), digest: "0".into() };
        let identity = Identity { vehicle: "uav".into(), bundle: "b".into(), map, provider: "cpu".into() };
        let health = Health::new(identity, Duration::from_secs(1));
        let inbox = Inbox::new(Tracker::new(Settings::defaults().unwrap().track), Attitudes::new(0.2));
        Intake::new(Arc::new(inbox), Arc::new(health), 100)
    }

    fn frame(intake: &Intake, attachment: &str, bytes: usize) {
        intake.take_frame(attachment.as_bytes(), bytes, || vec![7; bytes]);
    }

    fn attachment(stamp_ns: i64) -> String {
        format!(r#"{{"stamp_ns":{stamp_ns},"encoding":"png","width":640,"height":512,"yaw_deg":5}}"#)
    }

    fn next(intake: &Intake) -> Option<Job> {
        match intake.inbox.frames.pop(Duration::ZERO) {
            Popped::Item(job) => Some(job),
            _ => None,
        }
    }

    #[test]
    fn the_newest_frame_by_arrival_wins_and_every_frame_is_counted() {
        let intake = intake();
        for stamp_ns in [3, 9, 4] {
            frame(&intake, &attachment(stamp_ns), 10);
        }
        let job = next(&intake).unwrap();
        assert_eq!((job.stamp_ns, job.stated.yaw_deg), (4, Some(5.0)));
        assert_eq!(job.frame.unwrap().bytes.len(), 10);
        assert!(next(&intake).is_none());
        assert_eq!(intake.health.status().frames, FrameCounts { received: 3, accepted: 3, dropped: 2, bad: 0 });
    }

    #[test]
    fn what_cannot_be_read_is_answered_where_its_stamp_can() {
        let intake = intake();
        for garbage in ["", "{", "null", r#"{"stamp_ns":"now"}"#, &" ".repeat(MAX_MESSAGE_BYTES + 1)] {
            frame(&intake, garbage, 10);
            assert!(next(&intake).is_none());
        }
        assert_eq!(intake.health.status().frames, FrameCounts { received: 5, accepted: 0, dropped: 0, bad: 5 });
        frame(&intake, r#"{"stamp_ns":8,"encoding":"bmp","width":640,"height":512}"#, 10);
        let job = next(&intake).unwrap();
        assert_eq!(job.stamp_ns, 8);
        assert!(job.frame.unwrap_err().to_string().contains("bmp"));
        intake.take_frame(attachment(9).as_bytes(), 101, || panic!("what is too large is not copied"));
        let error = next(&intake).unwrap().frame.unwrap_err().to_string();
        assert_eq!(error, "frame: message: expected at most 100 bytes, found payload: 101 bytes");
    }

    #[test]
    fn a_refused_frame_displaces_nothing() {
        let intake = intake();
        frame(&intake, &attachment(3), 10);
        frame(&intake, &attachment(4), 101);
        assert_eq!(next(&intake).unwrap().stamp_ns, 3);
        assert_eq!(intake.health.status().frames, FrameCounts { received: 2, accepted: 2, dropped: 1, bad: 0 });
    }

    #[test]
    fn priors_and_attitudes_are_checked_and_counted() {
        let intake = intake();
        intake.prior(&ZBytes::from(r#"{"stamp_ns":5,"lat_deg":25,"lon_deg":55,"radius_m":512}"#));
        intake.prior(&ZBytes::from(r#"{"stamp_ns":5,"lat_deg":25,"lon_deg":55}"#));
        intake.prior(&ZBytes::from(vec![b'x'; 1 << 20]));
        assert_eq!(intake.health.status().priors, InputCounts { received: 3, bad: 2 });
        assert_eq!(lock(&intake.inbox.tracker).prior_at(5).unwrap().radius_m, 512.0);
        intake.attitude(&ZBytes::from(r#"{"stamp_ns":5,"roll_deg":1,"pitch_deg":2,"yaw_deg":3}"#));
        intake.attitude(&ZBytes::from(r#"{"stamp_ns":5,"roll_deg":1,"pitch_deg":2}"#));
        assert_eq!(intake.health.status().attitudes, InputCounts { received: 2, bad: 1 });
        assert_eq!(lock(&intake.inbox.attitudes).at(5).unwrap().roll_deg, Some(1.0));
    }
}
