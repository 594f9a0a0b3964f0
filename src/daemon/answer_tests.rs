//! The inference thread with a stand-in for the localizer.

use super::*;
use crate::bus::{MapId, Status};
use crate::config::Settings;
use crate::daemon::health::Identity;
use crate::geo::LatLon;
use crate::locate::{Fix, PriorSource, StageName};
use crate::track::{Guard, PriorReport, Spread};
use std::collections::BTreeMap;

const S: i64 = 1_000_000_000;

struct Bench {
    inbox: Inbox,
    outbox: Outbox,
    health: Health,
}

fn bench(deadline: Duration) -> Bench {
    let map = MapId { name: "m.tif".into(), digest: "0".into() };
    let identity = Identity { vehicle: "uav".into(), bundle: "b".into(), map, provider: "cpu".into() };
    let health = Health::new(identity, deadline);
    let tracker = Tracker::new(Settings::defaults().unwrap().track);
    Bench { inbox: Inbox::new(tracker, Attitudes::new(0.2)), outbox: Outbox::new(&health), health }
}

fn job(stamp_ns: i64) -> Job {
    let frame = FrameBytes { bytes: vec![1, 2, 3], encoding: Encoding::Png, size_px: (640, 512) };
    Job { stamp_ns, arrived: Instant::now(), frame: Ok(frame), stated: Pose::default() }
}

fn prior(stamp_ns: i64) -> PriorReport {
    let position = LatLon { lat_deg: 25.0, lon_deg: 55.0 };
    PriorReport { stamp_ns, position, spread: Spread::RadiusM(512.0), fix_seq: None }
}

/// Finds the vehicle where the prior is.
fn locate(query: &Query<'_>) -> Answer {
    let outcome = match (&query.prior, &query.frame) {
        (Err(no_fix), _) => Err(no_fix.clone()),
        (_, Err(error)) => Err(NoFix { reason: Reason::BadFrame, detail: error.to_string() }),
        (Ok(prior), Ok(_)) => Ok(Fix {
            position: prior.position,
            covariance_enu_m2: [[4.0, 0.0], [0.0, 4.0]],
            radius95_m: 5.0,
            radius999_m: 8.0,
            calibrated: false,
            p_over_25m: None,
            yaw_deg: 0.0,
            scale: 1.0,
            stage: StageName::Coarse,
            homography: [[1.0, 0.0, 512.0], [0.0, 1.0, 512.0], [0.0, 0.0, 1.0]],
        }),
    };
    Answer {
        withheld: None,
        bundle: None,
        searched: false,
        outcome,
        prior: query.prior.as_ref().ok().copied(),
        window: None,
        evidence: BTreeMap::new(),
        latency_ms: BTreeMap::from([("locate".to_owned(), 1.0)]),
    }
}

impl Bench {
    /// Answers the jobs one by one, each made when its turn comes, and gives what was said about each.
    fn answer(
        &self,
        jobs: impl IntoIterator<Item = Job>,
        deadline: Duration,
        locate: impl FnMut(&Query<'_>) -> Answer + Send,
    ) -> Vec<FixMessage> {
        self.answer_with(&Settings::defaults().unwrap(), jobs, deadline, locate)
    }

    fn answer_with(
        &self,
        settings: &Settings,
        jobs: impl IntoIterator<Item = Job>,
        deadline: Duration,
        locate: impl FnMut(&Query<'_>) -> Answer + Send,
    ) -> Vec<FixMessage> {
        let mut messages = Vec::new();
        std::thread::scope(|scope| {
            let guard = Guard::new(settings.track.clone(), true);
            scope.spawn(|| answer_frames(&self.inbox, &self.outbox, &self.health, settings, deadline, guard, locate));
            for job in jobs {
                let seq = self.outbox.last().message.seq;
                assert!(self.inbox.frames.push(job).is_none());
                let until = Instant::now() + Duration::from_secs(10);
                while self.outbox.last().message.seq == seq && Instant::now() < until {
                    std::thread::sleep(Duration::from_millis(1));
                }
                messages.push(self.outbox.last().message);
            }
            self.inbox.frames.close();
        });
        messages
    }
}

const LONG: Duration = Duration::from_secs(30);

#[test]
fn every_frame_gets_one_answer_with_the_next_number() {
    let bench = bench(LONG);
    lock(&bench.inbox.tracker).report(prior(100 * S));
    // A stamp that repeats, and one that lies before the last answered: newest by arrival, so answered all the same.
    let messages = bench.answer(vec![job(100 * S), job(100 * S), job(99 * S)], LONG, locate);
    assert_eq!(messages.iter().map(|m| (m.seq, m.stamp_ns)).collect::<Vec<_>>(), [(1, 100 * S), (2, 100 * S), (3, 99 * S)]);
    assert!(messages.iter().all(|m| m.status == Status::Fix));
    assert_eq!(messages[0].prior.unwrap().source, PriorSource::External);
    assert_eq!((messages[1].prior.unwrap().source, messages[1].prior.unwrap().chain), (PriorSource::OwnFix, 1));
    assert!(messages[0].latency_ms.contains_key("wait"));
    assert_eq!(bench.health.status().fixes, 3);
}

#[test]
fn without_a_prior_there_is_no_fix_and_a_bad_frame_says_so() {
    let bench = bench(LONG);
    let bad =
        |stamp_ns| Job { frame: Err(FrameError::Field { field: "x", expected: "a".into(), found: "b".into() }), ..job(stamp_ns) };
    let messages = bench.answer(vec![job(S), bad(S)], LONG, locate);
    assert_eq!(messages.iter().map(|m| m.reason).collect::<Vec<_>>(), [Some(Reason::NoPrior); 2]);
    let bench = self::bench(LONG);
    lock(&bench.inbox.tracker).report(prior(S));
    let messages = bench.answer(vec![bad(S)], LONG, locate);
    assert_eq!((messages[0].reason, messages[0].lat_deg), (Some(Reason::BadFrame), None));
}

#[test]
fn an_answer_after_the_deadline_is_none() {
    let deadline = Duration::from_secs(1);
    let bench = bench(deadline);
    lock(&bench.inbox.tracker).report(prior(S));
    let mut slow = true;
    let messages = bench.answer((0..2).map(|_| job(S)), deadline, |query| {
        if std::mem::take(&mut slow) {
            std::thread::sleep(Duration::from_millis(1100));
        }
        locate(query)
    });
    assert_eq!((messages[0].status, messages[0].reason), (Status::NoFix, Some(Reason::Deadline)));
    assert!(messages[0].lat_deg.is_none() && messages[0].covariance_enu_m2.is_none() && !messages[0].calibrated);
    assert!(messages[0].prior.is_some(), "what was known is still said");
    assert_eq!(messages[1].status, Status::Fix);
    assert_eq!(bench.health.status().no_fix[&Reason::Deadline], 1);
    assert_eq!(messages[1].prior.unwrap().source, PriorSource::External, "a fix that came too late is no prior");
}

#[test]
fn a_frame_that_waited_past_its_deadline_is_not_looked_at() {
    let deadline = Duration::from_millis(50);
    let bench = bench(deadline);
    let old = || Job { arrived: Instant::now().checked_sub(Duration::from_secs(1)).unwrap(), ..job(S) };
    let messages = bench.answer(vec![old()], deadline, |_| panic!("not to be called"));
    assert_eq!(messages[0].reason, Some(Reason::NoPrior), "the earlier reason goes first");
    let bench = self::bench(deadline);
    lock(&bench.inbox.tracker).report(prior(S));
    let messages = bench.answer(vec![old()], deadline, |_| panic!("not to be called"));
    assert_eq!(messages[0].reason, Some(Reason::Deadline));
}

#[test]
fn the_pose_comes_from_the_frame_then_from_the_attitude() {
    let bench = bench(LONG);
    lock(&bench.inbox.attitudes).push(crate::bus::AttitudeMessage {
        stamp_ns: S,
        roll_deg: 1.0,
        pitch_deg: 2.0,
        yaw_deg: 30.0,
        agl_m: Some(400.0),
    });
    let stated = Pose { yaw_deg: Some(5.0), hfov_deg: Some(40.0), ..Pose::default() };
    let seen = Mutex::new(Vec::new());
    bench.answer(vec![Job { stated, ..job(S) }, job(9 * S)], LONG, |query| {
        lock(&seen).push(query.pose);
        locate(query)
    });
    let seen = seen.into_inner().unwrap();
    assert_eq!((seen[0].yaw_deg, seen[0].hfov_deg, seen[0].agl_m), (Some(5.0), Some(40.0), Some(400.0)));
    assert!((seen[0].pitch_deg.unwrap() - 2.0).abs() < 1e-9);
    assert_eq!(seen[1], Pose::default(), "too old is unknown");
}

#[test]
fn a_tilted_mount_without_an_attitude_counts_and_its_tilt_is_not_known() {
    let bench = bench(LONG);
    lock(&bench.inbox.tracker).report(prior(S));
    lock(&bench.inbox.attitudes).push(crate::bus::AttitudeMessage {
        stamp_ns: 2 * S,
        roll_deg: 1.0,
        pitch_deg: 2.0,
        yaw_deg: 30.0,
        agl_m: None,
    });
    let picture = |i: i64, stated: Pose| {
        let frame = FrameBytes { bytes: vec![i as u8], encoding: Encoding::Png, size_px: (640, 512) };
        Job { frame: Ok(frame), stated, ..job(i * S) }
    };
    let half = Pose { pitch_deg: Some(10.0), ..Pose::default() };
    let whole = Pose { roll_deg: Some(0.0), ..half };
    let jobs = vec![picture(1, Pose::default()), picture(2, Pose::default()), picture(3, half), picture(4, whole)];
    let mut settings = Settings::defaults().unwrap();
    settings.camera.mount_pitch_deg = 10.0;
    let pitches = Mutex::new(Vec::new());
    let messages = bench.answer_with(&settings, jobs, LONG, |query| {
        lock(&pitches).push(query.pose.pitch_deg.unwrap());
        let mut answer = locate(query);
        answer.evidence.insert("tilt_lever_m".to_owned(), 400.0);
        answer.evidence.insert("sigma_tilt_m".to_owned(), 400.0 * 0.5_f64.to_radians());
        answer
    });
    let pitches: Vec<i64> = pitches.into_inner().unwrap().iter().map(|p| p.round() as i64).collect();
    assert_eq!(pitches, [10, 12, 10, 10]);
    let tilts: Vec<i64> = messages.iter().map(|m| (m.evidence["sigma_tilt_m"] * 10.0).round() as i64).collect();
    assert_eq!(tilts, [140, 35, 140, 35]);
    assert!(messages[0].covariance_enu_m2.unwrap()[0][0] > messages[1].covariance_enu_m2.unwrap()[0][0]);
}

/// Through two real messages: what we publish, and what an estimator makes of it.
#[test]
fn the_echo_of_our_own_fix_is_known_and_its_depth_is_said() {
    let bench = bench(LONG);
    lock(&bench.inbox.tracker).report(prior(S));
    let picture = |i: i64| {
        let frame = FrameBytes { bytes: vec![i as u8], encoding: Encoding::Png, size_px: (640, 512) };
        Job { frame: Ok(frame), ..job(i * S) }
    };
    let echo_of_last = |stamp_ns: i64, honest: bool| {
        let fix = serde_json::to_value(bench.outbox.last().message).unwrap();
        let mut prior = serde_json::json!({
            "stamp_ns": stamp_ns, "lat_deg": fix["lat_deg"], "lon_deg": fix["lon_deg"], "sigma_m": 2.0,
        });
        if honest {
            prior["fix_seq"] = fix["seq"].clone();
        }
        let message = crate::bus::PriorMessage::parse(&serde_json::to_vec(&prior).unwrap()).unwrap();
        assert!(lock(&bench.inbox.tracker).report(message.report().unwrap()));
    };
    let jobs = (1..=4).map(|i| {
        if i > 1 {
            echo_of_last(i * S, i < 4);
        }
        picture(i)
    });
    let messages: Vec<_> = bench.answer(jobs, LONG, locate).iter().map(|m| serde_json::to_value(m).unwrap()).collect();
    let prior = |i: usize| (messages[i]["prior"]["source"].clone(), messages[i]["prior"]["chain"].clone());
    assert!(messages.iter().all(|message| message["status"] == "fix"), "{messages:#?}");
    assert_eq!(prior(0), ("external".into(), 0.into()));
    // A fix from an external prior, echoed: its echo is two deep, and so on.
    assert_eq!(prior(1), ("own_fix".into(), 2.into()));
    assert_eq!(messages[1]["prior"]["sigma_m"], 50.0, "however sure the estimator is of what we told it");
    assert_eq!(prior(2), ("own_fix".into(), 4.into()));
    // Without `fix_seq` an echo cannot be told from a prior of its own right.
    assert_eq!(prior(3), ("external".into(), 0.into()));
}

/// A picture that stands still with bytes that change: one place for ever by way of own fixes, each nearer in time than the
/// external prior, which comes once a second and a second late.
#[test]
fn an_external_prior_ends_a_chain_of_own_fixes() {
    let bench = bench(LONG);
    let home = LatLon { lat_deg: 25.0, lon_deg: 55.0 };
    let hertz4 = (0..48).map(|i: i64| {
        if i % 4 == 0 {
            // 20 m/s to the north, known to 100 m.
            let then = (i - 4).max(0);
            let position = home.offset(crate::geo::Enu { east_m: 0.0, north_m: 5.0 * then as f64 });
            let known = PriorReport { position, spread: Spread::RadiusM(100.0), ..prior(S + then * S / 4) };
            assert!(lock(&bench.inbox.tracker).report(known));
        }
        let frame = FrameBytes { bytes: vec![i as u8], encoding: Encoding::Png, size_px: (640, 512) };
        Job { frame: Ok(frame), ..job(S + i * S / 4) }
    });
    let messages = bench.answer(hertz4, LONG, |query| {
        let mut answer = locate(query);
        let reach_m = query.prior.as_ref().map_or(0.0, |prior| prior.position.distance_m(home) - prior.radius_m);
        match &mut answer.outcome {
            Ok(fix) if reach_m <= 0.0 => fix.position = home,
            _ => answer.outcome = Err(NoFix::new(Reason::OutsidePrior, "")),
        }
        answer
    });
    assert!(messages[..32].iter().all(|message| message.status == Status::Fix));
    let held = &messages[36];
    assert_eq!((held.reason, held.prior.unwrap().source), (Some(Reason::HeldBack), PriorSource::OwnFix));
    assert!(held.detail.as_deref().unwrap().contains("external prior"), "{held:?}");
    // 160 m off by then, of 100 m + 25 x 1.75 m at most; five in a row, and the chain is given up.
    assert!(messages[36..].iter().all(|message| message.status == Status::NoFix));
    assert_eq!(messages[41].prior.unwrap().source, PriorSource::External);
}

#[test]
fn what_the_guard_holds_back_is_said_and_becomes_no_prior() {
    let bench = bench(LONG);
    lock(&bench.inbox.tracker).report(prior(S));
    let picture = |i: i64| {
        let frame = FrameBytes { bytes: vec![i as u8], encoding: Encoding::Png, size_px: (640, 512) };
        Job { frame: Ok(frame), ..job(S + i * S / 10) }
    };
    let mut count = 0;
    let messages = bench.answer((0..3).map(picture), LONG, |query| {
        let mut answer = locate(query);
        count += 1;
        if let (2, Ok(fix)) = (count, &mut answer.outcome) {
            fix.position = fix.position.offset(crate::geo::Enu { east_m: 140.0, north_m: 0.0 });
        }
        answer
    });
    assert_eq!(messages.iter().map(|m| m.reason).collect::<Vec<_>>(), [None, Some(Reason::HeldBack), None]);
    assert!(messages[1].lat_deg.is_none() && messages[1].detail.as_deref().unwrap().contains("found 140.0 m"));
    assert_eq!((messages[2].prior.unwrap().chain, messages[2].prior.unwrap().lon_deg), (1, 55.0));
    assert_eq!(bench.health.status().no_fix[&Reason::HeldBack], 1);
}
