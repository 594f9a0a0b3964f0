//! One test per rule of the guard, then properties over flights.

use super::*;
use crate::geo::Enu;
use proptest::prelude::*;

const S: i64 = 1_000_000_000;
const T0: i64 = 1_700_000_000 * S;

fn settings() -> TrackSettings {
    TrackSettings { frozen_frames: 3, ..crate::config::Settings::defaults().unwrap().track }
}

fn guard() -> Guard {
    Guard::new(settings(), true)
}

fn place(east_m: f64, north_m: f64) -> LatLon {
    LatLon { lat_deg: 25.2, lon_deg: 55.3 }.offset(Enu { east_m, north_m })
}

fn external(at: LatLon, radius_m: f64, age_s: f64) -> Prior {
    Prior { position: at, radius_m, sigma_m: None, source: PriorSource::External, chain: 0, age_s: Some(age_s) }
}

fn own(at: LatLon) -> Prior {
    Prior { source: PriorSource::OwnFix, chain: 1, sigma_m: Some(50.0), ..external(at, 150.0, 1.0) }
}

fn answer(at: LatLon, prior: Prior) -> Answer {
    let (calibrated, p_over_25m) = (true, Some(0.01));
    let fix = Fix { radius95_m: 7.3, radius999_m: 11.2, calibrated, p_over_25m, ..Fix::plain(at, 3.0) };
    Answer::bare(Ok(fix), Some(prior))
}

fn searched(at: LatLon, radius_m: f64) -> Answer {
    Answer { searched: true, ..answer(at, external(place(0.0, 0.0), radius_m, 0.0)) }
}

/// What becomes of an answer whose picture is a new one.
fn judge(guard: &mut Guard, stamp_ns: i64, mut answer: Answer) -> Result<Fix, NoFix> {
    guard.judge(stamp_ns, None, None, &mut answer);
    answer.outcome
}

/// A fix with an own prior.
fn track(guard: &mut Guard, stamp_ns: i64, east_m: f64) -> bool {
    let at = place(east_m, 0.0);
    let outcome = judge(guard, stamp_ns, answer(at, own(at)));
    assert!(outcome.as_ref().err().is_none_or(|no_fix| no_fix.reason == Reason::HeldBack));
    outcome.is_ok()
}

#[test]
fn a_jump_is_held_back_until_other_ground_agrees() {
    let mut guard = guard();
    assert!(track(&mut guard, T0, 0.0));
    assert!(track(&mut guard, T0 + S, 20.0));
    // 25 m/s + 3 x (3 + 3) m + 10 m = 53 m from the last one.
    assert!(track(&mut guard, T0 + 2 * S, 72.9));
    assert!(!track(&mut guard, T0 + 3 * S, 72.9 + 53.1));
    // The track goes on where it was: what was held back is forgotten.
    assert!(track(&mut guard, T0 + 4 * S, 80.0));
    assert!(!track(&mut guard, T0 + 5 * S, 300.0));
    assert!(!track(&mut guard, T0 + 5 * S + S / 2, 305.0), "5 m and half a second on is the same ground");
    assert_eq!(calibrated(&mut guard, T0 + 6 * S, 345.0), Some(true), "45 m on is not");
    assert!(track(&mut guard, T0 + 7 * S, 360.0));
}

/// Whether a fix at this place, with an own prior, is published as calibrated; None: held back.
fn calibrated(guard: &mut Guard, stamp_ns: i64, east_m: f64) -> Option<bool> {
    let at = place(east_m, 0.0);
    let fix = judge(guard, stamp_ns, answer(at, own(at))).ok()?;
    assert_eq!(fix.p_over_25m.is_some(), fix.calibrated);
    Some(fix.calibrated)
}

#[test]
fn a_place_that_stands_still_is_confirmed_later_and_not_calibrated_before_it_moves() {
    let mut guard = guard();
    assert_eq!(calibrated(&mut guard, T0, 0.0), Some(true));
    assert_eq!(calibrated(&mut guard, T0 + S, 400.0), None);
    assert_eq!(calibrated(&mut guard, T0 + 2 * S, 400.0), None);
    assert_eq!(calibrated(&mut guard, T0 + 3 * S, 401.0), Some(false));
    assert_eq!(calibrated(&mut guard, T0 + 4 * S, 420.0), Some(false));
    assert_eq!(calibrated(&mut guard, T0 + 6 * S, 440.9), Some(false), "39.9 m on");
    assert_eq!(calibrated(&mut guard, T0 + 7 * S, 441.1), Some(true));
    assert_eq!(calibrated(&mut guard, T0 + 8 * S, 402.0), Some(true), "once settled it stays so");
}

#[test]
fn a_searched_place_of_a_vehicle_that_hovers_stays_held() {
    let mut guard = guard();
    for i in 0..20 {
        assert!(judge(&mut guard, T0 + i * S, searched(place(1500.0 + (i % 2) as f64, 0.0), 3000.0)).is_err());
    }
    let moved = judge(&mut guard, T0 + 21 * S, searched(place(1542.0, 0.0), 3000.0));
    assert!(moved.is_ok());
}

#[test]
fn wrong_places_between_right_ones_confirm_nothing() {
    let mut guard = guard();
    for i in 0..10 {
        assert!(track(&mut guard, T0 + 2 * i * S, 20.0 * i as f64));
        assert!(!track(&mut guard, T0 + (2 * i + 1) * S, 900.0 + 20.0 * i as f64), "the same wrong place again");
    }
}

#[test]
fn an_older_fix_does_not_confirm_a_jump() {
    let mut guard = guard();
    for i in 0..30 {
        assert!(track(&mut guard, T0 + i * S, 5.0 * i as f64));
    }
    assert!(!track(&mut guard, T0 + 30 * S, 450.0), "25 m/s from the fix 20 s ago reaches here");
}

#[test]
fn more_confirmations_need_more_ground() {
    let mut guard = Guard::new(TrackSettings { confirmations: 2, ..settings() }, true);
    assert!(track(&mut guard, T0, 0.0));
    for (i, passes) in [false, false, true].into_iter().enumerate() {
        assert_eq!(track(&mut guard, T0 + (i as i64 + 1) * 2 * S, 800.0), passes);
    }
}

#[test]
fn independent_external_priors_explain_their_jumps_and_no_other_frame_s() {
    let mut guard = guard();
    for i in 0..8 {
        let at = place(if i % 2 == 0 { 0.0 } else { 3000.0 }, 40.0 * f64::from(i));
        assert!(judge(&mut guard, T0 + i64::from(i) * 10 * S, answer(at, external(at, 512.0, 0.0))).is_ok());
    }
    // The next frame has no report of its own: neither the old one again, aged, nor an own fix explain a jump.
    let last = place(3000.0, 280.0);
    let jump = place(2500.0, 280.0);
    let old = Prior { age_s: Some(1.0), ..external(last, 537.0, 1.0) };
    assert!(judge(&mut guard, T0 + 71 * S, answer(jump, old)).is_err());
    assert!(judge(&mut guard, T0 + 71 * S, answer(jump, own(last))).is_err());
}

#[test]
fn a_continuous_source_explains_no_jump_and_one_that_restarts_does() {
    let mut guard = guard();
    let along = |i: i64| place(20.0 * i as f64, 0.0);
    for i in 0..8 {
        assert!(judge(&mut guard, T0 + i * S, answer(along(i), external(along(i), 512.0, 0.0))).is_ok());
    }
    let jump = place(160.0, 400.0);
    let refused = judge(&mut guard, T0 + 8 * S, answer(jump, external(along(8), 512.0, 0.0))).unwrap_err();
    assert_eq!(refused.reason, Reason::HeldBack);
    assert!(refused.detail.contains("found 400"), "{}", refused.detail);
    // The estimator itself is moved by 2 km: where it is now the fix may be too.
    let there = place(2160.0, 0.0);
    assert!(judge(&mut guard, T0 + 9 * S, answer(there, external(there, 512.0, 0.0))).is_ok());
}

#[test]
fn one_step_that_can_be_flown_makes_a_source_continuous() {
    let mut guard = guard();
    for i in 0..2 {
        let at = place(20.0 * f64::from(i), 0.0);
        let outcome = judge(&mut guard, T0 + i64::from(i) * S, answer(at, external(at, 512.0, 0.0)));
        assert!(outcome.is_ok());
    }
    let jump = judge(&mut guard, T0 + 2 * S, answer(place(40.0, 400.0), external(place(40.0, 0.0), 512.0, 0.0)));
    assert_eq!(jump.unwrap_err().reason, Reason::HeldBack);
}

#[test]
fn a_report_that_an_unanswered_frame_used_is_still_new() {
    let mut guard = guard();
    assert!(judge(&mut guard, T0, answer(place(0.0, 0.0), external(place(0.0, 0.0), 300.0, 0.0))).is_ok());
    let there = place(5000.0, 0.0);
    let mut nothing = answer(there, external(there, 300.0, 0.0));
    nothing.outcome = Err(NoFix::new(Reason::LowEvidence, ""));
    assert_eq!(judge(&mut guard, T0 + S, nothing).unwrap_err().reason, Reason::LowEvidence, "a reason stays");
    assert!(judge(&mut guard, T0 + 2 * S, answer(there, external(there, 325.0, 1.0))).is_ok());
}

#[test]
fn a_searched_place_needs_a_second_frame_of_other_ground() {
    let mut guard = guard();
    let near = |i: f64| place(1500.0 + 20.0 * i, 0.0);
    let held = judge(&mut guard, T0, searched(near(0.0), 3000.0)).unwrap_err();
    assert_eq!(held.reason, Reason::HeldBack);
    assert!(held.detail.starts_with("position found by a search"), "{}", held.detail);
    assert!(judge(&mut guard, T0 + S, searched(near(1.0), 3000.0)).is_err(), "20 m and 1 s: the same ground");
    assert!(judge(&mut guard, T0 + 2 * S, searched(place(-900.0, 500.0), 3000.0)).is_err(), "elsewhere");
    let mut second = searched(near(3.0), 3000.0);
    guard.judge(T0 + 3 * S, None, None, &mut second);
    assert!(second.outcome.is_ok() && second.searched);
    // A published fix confirms too; and what was not searched for needs none.
    assert!(judge(&mut guard, T0 + 6 * S, searched(near(6.0), 3000.0)).is_ok());
    assert!(track(&mut guard, T0 + 7 * S, 1640.0));
}

#[test]
fn agreement_that_chance_gives_confirms_no_search() {
    // 20 s apart at 25 m/s: 528 m would agree, in a search of 1 km radius one time in four.
    let mut near = guard();
    assert!(judge(&mut near, T0, searched(place(0.0, 0.0), 1000.0)).is_err());
    assert!(judge(&mut near, T0 + 20 * S, searched(place(300.0, 0.0), 1000.0)).is_err());
    let mut wide = guard();
    assert!(judge(&mut wide, T0, searched(place(0.0, 0.0), 3000.0)).is_err());
    assert!(judge(&mut wide, T0 + 20 * S, searched(place(300.0, 0.0), 3000.0)).is_ok());
    let mut late = guard();
    assert!(judge(&mut late, T0, searched(place(0.0, 0.0), 10_000.0)).is_err());
    assert!(judge(&mut late, T0 + 31 * S, searched(place(300.0, 0.0), 10_000.0)).is_err());
}

fn look(guard: &mut Guard, stamp_ns: i64, picture: &[u8]) -> Answer {
    let mut answer = answer(place(0.0, 0.0), own(place(0.0, 0.0)));
    guard.judge(stamp_ns, Some(picture), None, &mut answer);
    answer
}

#[test]
fn a_frozen_camera_widens_then_closes_and_a_new_picture_opens() {
    let mut guard = guard();
    assert!(look(&mut guard, T0, b"one").outcome.unwrap().calibrated);
    let again = look(&mut guard, T0 + 2 * S, b"one");
    assert_eq!(again.evidence["picture_age_s"], 2.0);
    let fix = again.outcome.unwrap();
    assert_eq!((fix.radius999_m, fix.calibrated, fix.p_over_25m), (11.2 + 50.0, false, None));
    assert_eq!(fix.covariance_enu_m2, [[2509.0, 0.0], [0.0, 2509.0]]);
    for i in 3..6 {
        let refused = look(&mut guard, T0 + i * S, b"one").outcome.unwrap_err();
        assert_eq!(refused.reason, Reason::HeldBack);
        assert!(refused.detail.contains("frozen"), "{}", refused.detail);
    }
    assert!(look(&mut guard, T0 + 6 * S, b"two").outcome.unwrap().calibrated);
    // It is remembered over others and over frames without bytes, until 16 others were seen since.
    assert_eq!(look(&mut guard, T0 + 7 * S, b"one").outcome.unwrap_err().reason, Reason::HeldBack);
    let mut none = answer(place(0.0, 0.0), own(place(0.0, 0.0)));
    guard.judge(T0 + 8 * S, None, None, &mut none);
    assert_eq!(look(&mut guard, T0 + 9 * S, b"one").outcome.unwrap_err().reason, Reason::HeldBack);
    for i in 0..16 {
        assert!(look(&mut guard, T0 + (10 + i) * S, &[i as u8]).outcome.unwrap().calibrated);
    }
    assert!(look(&mut guard, T0 + 900 * S, b"one").outcome.unwrap().calibrated);
}

#[test]
fn a_driver_that_goes_round_in_its_buffers_is_frozen_too() {
    let mut guard = Guard::new(TrackSettings { frozen_frames: 10, ..settings() }, true);
    let outcomes: Vec<_> = (0..40).map(|i: i64| look(&mut guard, T0 + i * S / 9, &[(i % 3) as u8]).outcome).collect();
    assert!(outcomes[..3].iter().all(|outcome| outcome.as_ref().unwrap().calibrated));
    assert!(outcomes[3..27].iter().all(|outcome| !outcome.as_ref().unwrap().calibrated));
    assert!(outcomes[27..].iter().all(|outcome| outcome.as_ref().unwrap_err().detail.contains("frozen")));
}

#[test]
fn one_exposure_sent_again_is_not_frozen_nor_is_a_fast_stream_of_a_slow_camera() {
    let mut guard = guard();
    for _ in 0..5 {
        assert!(look(&mut guard, T0, b"one").outcome.unwrap().calibrated);
    }
    // 60 Hz of a 9 Hz core: each picture some seven times, within 0.12 s.
    for i in 0..60 {
        let answer = look(&mut guard, T0 + S + i * S / 60, &[(i / 7) as u8]);
        assert!(answer.outcome.is_ok());
    }
    assert!(look(&mut guard, T0 + 3 * S, b"three").outcome.is_ok());
}

#[test]
fn switched_off_it_changes_nothing() {
    let mut guard = Guard::new(settings(), false);
    for i in 0..5 {
        let before = Answer { searched: true, ..answer(place(5000.0 * i as f64, 0.0), own(place(0.0, 0.0))) };
        let mut after = before.clone();
        guard.judge(T0 + i * S, Some(b"same"), Some(&external(place(0.0, 0.0), 10.0, 0.0)), &mut after);
        assert_eq!(before, after);
    }
}

#[test]
fn what_is_held_back_is_no_prior() {
    use crate::track::{PriorReport, Spread, Tracker};
    let (mut guard, mut tracker) = (guard(), Tracker::new(settings()));
    let start = PriorReport { stamp_ns: T0, position: place(0.0, 0.0), spread: Spread::RadiusM(512.0), fix_seq: None };
    assert!(tracker.report(start));
    for (seq, east_m) in [(0, 0.0), (1, 400.0)] {
        let stamp_ns = T0 + i64::try_from(seq).unwrap() * S;
        let mut answer = answer(place(east_m, 0.0), tracker.prior_at(stamp_ns).unwrap());
        guard.judge(stamp_ns, None, None, &mut answer);
        tracker.record(stamp_ns, seq, &answer);
    }
    let prior = tracker.prior_at(T0 + 2 * S).unwrap();
    assert_eq!((prior.source, prior.position), (PriorSource::OwnFix, place(0.0, 0.0)));
}

#[test]
fn a_fix_outside_the_external_disc_is_held_back_and_confirms_nothing() {
    let mut guard = guard();
    let stale = answer(place(0.0, 0.0), own(place(0.0, 0.0)));
    let bound = |east_m: f64, radius_m: f64| external(place(east_m, 0.0), radius_m, 0.25);
    let judge = |guard: &mut Guard, i: i64, bound: Prior| {
        let mut answer = stale.clone();
        guard.judge(T0 + i * 4 * S, None, Some(&bound), &mut answer);
        answer.outcome
    };
    assert!(judge(&mut guard, 0, bound(99.9, 100.0)).is_ok());
    for i in 1..4 {
        let refused = judge(&mut guard, i, bound(101.0, 100.0)).unwrap_err();
        assert_eq!(refused.reason, Reason::HeldBack);
        assert!(
            refused.detail.contains("external prior of 0.25 s before") && refused.detail.contains("found 101"),
            "{}",
            refused.detail
        );
    }
    assert!(guard.held.newest_first().next().is_none());
    assert!(judge(&mut guard, 4, bound(300.0, 400.0)).is_ok(), "an old prior has a wide disc");
    assert!(judge(&mut guard, 5, bound(0.0, f64::NAN)).is_err());
}

#[test]
fn numbers_that_are_none_and_stamps_at_the_ends_are_survived() {
    let mut guard = guard();
    assert!(track(&mut guard, T0, 0.0));
    let mut odd = answer(place(0.0, 0.0), own(place(0.0, 0.0)));
    if let Ok(fix) = &mut odd.outcome {
        fix.covariance_enu_m2 = [[f64::NAN, 0.0], [0.0, 9.0]];
    }
    assert!(judge(&mut guard, T0 + S, odd).is_err(), "an error that is no number explains nothing");
    for stamp_ns in [i64::MIN, i64::MAX, 0, -1, i64::MIN] {
        for age_s in [f64::NAN, f64::INFINITY, -1e300, 1e300] {
            let at = place(0.0, 0.0);
            let _ = judge(&mut guard, stamp_ns, answer(at, external(at, 512.0, age_s)));
            let _ = look(&mut guard, stamp_ns, b"same");
        }
    }
}

#[test]
fn a_clock_that_steps_back_leaves_the_past_behind() {
    let mut guard = guard();
    for i in 0..8 {
        assert!(track(&mut guard, T0 + 3600 * S + i * S, 20.0 * i as f64));
    }
    assert!(track(&mut guard, T0, 5000.0), "an hour explains it");
    assert!(track(&mut guard, T0 + S, 5020.0));
    assert!(!track(&mut guard, T0 + 2 * S, 5400.0));
}

/// A flight that a vehicle can fly: seconds and steps as shares of what it may do, and an error within 3 sigma.
fn flyable() -> impl Strategy<Value = Vec<(i64, f64, f64, f64, f64)>> {
    prop::collection::vec((1..20_000_i64, 0.0..1.0, 0.0..360.0, 0.0..9.0, 0.0..360.0), 1..40)
}

fn fly(steps: &[(i64, f64, f64, f64, f64)]) -> Vec<(i64, LatLon)> {
    let (mut at_ns, mut at) = (T0, [0.0_f64, 0.0]);
    let go = |at: [f64; 2], by_m: f64, to_deg: f64| {
        let (sin, cos) = to_deg.to_radians().sin_cos();
        [at[0] + by_m * sin, at[1] + by_m * cos]
    };
    steps
        .iter()
        .map(|(ms, share, to_deg, error_m, error_deg)| {
            at_ns += ms * 1_000_000;
            at = go(at, 25.0 * *ms as f64 / 1e3 * share, *to_deg);
            let seen = go(at, *error_m, *error_deg);
            (at_ns, place(seen[0], seen[1]))
        })
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Whatever flies as the vehicle can is published, also where neighbours change places in time.
    #[test]
    fn flyable_flights_are_published(steps in flyable(), swaps in prop::collection::vec(0..40_usize, 0..6)) {
        let (mut guard, mut flight) = (guard(), fly(&steps));
        for i in swaps {
            if i + 1 < flight.len() {
                flight.swap(i, i + 1);
            }
        }
        for (at_ns, at) in flight {
            prop_assert!(judge(&mut guard, at_ns, answer(at, own(at))).is_ok());
        }
    }

    /// One wrong place in a flight is never published, and costs no other frame.
    #[test]
    fn one_outlier_is_held_back(steps in flyable(), which in 1..40_usize, off_m in 600.0..5000.0, to_deg in 0.0..360.0) {
        let (mut guard, flight) = (guard(), fly(&steps));
        for (i, (at_ns, at)) in flight.into_iter().enumerate() {
            let (sin, cos) = f64::to_radians(to_deg).sin_cos();
            let by = Enu { east_m: off_m * sin, north_m: off_m * cos };
            // Beyond what 20 s of motion and the errors reach.
            let wrong = i == which;
            let seen = if wrong { at.offset(by).offset(by) } else { at };
            prop_assert_eq!(judge(&mut guard, at_ns, answer(seen, own(at))).is_ok(), !wrong);
        }
    }

    /// Independent places, each with its own external prior, are all published: their priors are no flight.
    #[test]
    fn independent_places_are_published(
        steps in prop::collection::vec((300.0..6000.0, 0.0..360.0, 0.0..120.0, 0.0..360.0), 1..60),
    ) {
        let (mut guard, mut at) = (guard(), place(0.0, 0.0));
        let towards = |m: f64, to_deg: f64| {
            let (sin, cos) = f64::to_radians(to_deg).sin_cos();
            Enu { east_m: m * sin, north_m: m * cos }
        };
        for (i, (step_m, to_deg, off_m, off_deg)) in steps.into_iter().enumerate() {
            at = at.offset(towards(step_m, to_deg));
            let prior = external(at.offset(towards(off_m, off_deg)), 512.0, 0.0);
            prop_assert!(judge(&mut guard, T0 + i as i64 * S, answer(at, prior)).is_ok());
        }
    }

    /// Nothing that was searched for goes out before something else agrees; the same in, the same out.
    #[test]
    fn searched_places_never_go_first(
        places in prop::collection::vec((0..4000_i64, -3000.0..3000.0, -3000.0..3000.0, any::<bool>()), 1..30),
    ) {
        let (mut guard, mut twin) = (guard(), guard());
        let mut before: Vec<(i64, LatLon)> = Vec::new();
        for (ms, east_m, north_m, is_searched) in places {
            let (at_ns, at) = (T0 + ms * 1_000_000, place(east_m, north_m));
            let answer = if is_searched { searched(at, 4000.0) } else { answer(at, own(at)) };
            let outcome = judge(&mut guard, at_ns, answer.clone());
            prop_assert_eq!(&outcome, &judge(&mut twin, at_ns, answer));
            if is_searched && outcome.is_ok() {
                let reach_m = |t: i64| 25.0 * age_s(at_ns, t).abs() + 18.0 + 10.0;
                prop_assert!(before.iter().any(|(t, p)| p.distance_m(at) <= reach_m(*t)));
            }
            before.push((at_ns, at));
        }
    }
}
