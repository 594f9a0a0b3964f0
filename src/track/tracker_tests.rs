//! One test per rule of the contract's "Prior and search disc".

use super::*;
use crate::geo::Enu;
use crate::locate::Fix;

const S: i64 = 1_000_000_000;
const T0: i64 = 1_700_000_000 * S;

fn settings() -> TrackSettings {
    crate::config::Settings::defaults().unwrap().track
}

fn tracker() -> Tracker {
    Tracker::new(settings()).with_search_radius_m(512.0)
}

fn place(east_m: f64) -> LatLon {
    LatLon { lat_deg: 25.2, lon_deg: 55.3 }.offset(Enu { east_m, north_m: 0.0 })
}

fn radius(stamp_ns: i64, east_m: f64, radius_m: f64) -> PriorReport {
    PriorReport { stamp_ns, position: place(east_m), spread: Spread::RadiusM(radius_m), fix_seq: None }
}

fn sigma(stamp_ns: i64, east_m: f64, sigma_m: f64) -> PriorReport {
    PriorReport { spread: Spread::SigmaM(sigma_m), ..radius(stamp_ns, east_m, 1.0) }
}

fn fix(east_m: f64, sigma_m: f64, prior: Option<Prior>) -> Answer {
    Answer::bare(Ok(Fix::plain(place(east_m), sigma_m)), prior)
}

fn no_fix() -> Answer {
    Answer::bare(Err(NoFix::new(Reason::LowEvidence, "")), None)
}

fn close(a: f64, b: f64) {
    assert!((a - b).abs() < 1e-6, "{a} != {b}");
}

#[test]
fn without_any_report_there_is_no_prior() {
    let mut tracker = tracker();
    assert_eq!(tracker.prior_at(T0).unwrap_err().reason, Reason::NoPrior);
    tracker.record(T0, 0, &no_fix());
    assert_eq!(tracker.prior_at(T0).unwrap_err().reason, Reason::NoPrior);
}

#[test]
fn a_radius_is_taken_as_told_and_grows_by_speed_times_age() {
    let mut tracker = tracker();
    assert!(tracker.report(radius(T0, 0.0, 512.0)));
    let prior = tracker.prior_at(T0).unwrap();
    assert_eq!((prior.radius_m, prior.sigma_m, prior.source, prior.chain), (512.0, None, PriorSource::External, 0));
    assert_eq!(prior.age_s, Some(0.0));
    close(tracker.prior_at(T0 + 4 * S).unwrap().radius_m, 512.0 + 4.0 * 25.0);
}

#[test]
fn a_sigma_gives_a_disc_of_three() {
    let mut tracker = tracker();
    tracker.report(sigma(T0, 0.0, 10.0));
    let prior = tracker.prior_at(T0).unwrap();
    assert_eq!((prior.radius_m, prior.sigma_m), (30.0, Some(10.0)), "an external prior has no floor");
    let prior = tracker.prior_at(T0 + 2 * S).unwrap();
    close(prior.sigma_m.unwrap(), 60.0);
    close(prior.radius_m, 180.0);
}

#[test]
fn an_old_external_prior_is_stale_not_absent() {
    let mut tracker = tracker();
    tracker.report(radius(T0, 0.0, 100.0));
    assert!(tracker.prior_at(T0 + 600 * S).is_ok());
    let refused = tracker.prior_at(T0 + 601 * S).unwrap_err();
    assert_eq!(refused.reason, Reason::StalePrior);
    assert!(refused.detail.contains("601"), "{}", refused.detail);
    assert_eq!(tracker.prior_at(T0 - 601 * S).unwrap_err().reason, Reason::StalePrior, "from the far future: no better");
}

#[test]
fn the_last_fix_is_the_next_prior_with_a_floor_and_one_deeper() {
    let mut tracker = tracker();
    tracker.report(radius(T0, 0.0, 512.0));
    let first = tracker.prior_at(T0).unwrap();
    tracker.record(T0, 0, &fix(70.0, 3.0, Some(first)));
    let second = tracker.prior_at(T0 + S).unwrap();
    assert_eq!((second.source, second.chain), (PriorSource::OwnFix, 1));
    assert_eq!(second.position, place(70.0));
    close(second.sigma_m.unwrap(), 50.0 + 25.0);
    close(second.radius_m, 225.0);
    tracker.record(T0 + S, 1, &fix(80.0, 3.0, Some(second)));
    let third = tracker.prior_at(T0 + 2 * S).unwrap();
    assert_eq!((third.chain, third.position), (2, place(80.0)));
}

#[test]
fn a_fix_worse_than_the_floor_keeps_its_worst_axis() {
    let mut tracker = tracker();
    let mut answer = fix(0.0, 10.0, None);
    if let Ok(fix) = &mut answer.outcome {
        // Eigenvalues 80^2 and 20^2, turned by 45 degrees.
        fix.covariance_enu_m2 = [[3400.0, 3000.0], [3000.0, 3400.0]];
    }
    tracker.record(T0, 0, &answer);
    close(tracker.prior_at(T0).unwrap().sigma_m.unwrap(), 80.0);
}

#[test]
fn five_no_fix_in_a_row_fall_back_to_the_external_prior() {
    let mut tracker = tracker();
    tracker.report(radius(T0, 0.0, 300.0));
    tracker.record(T0, 0, &fix(70.0, 3.0, None));
    for seq in 1..=4 {
        tracker.record(T0 + S, seq, &no_fix());
    }
    assert_eq!(tracker.prior_at(T0 + 2 * S).unwrap().source, PriorSource::OwnFix);
    tracker.record(T0 + S, 5, &no_fix());
    let prior = tracker.prior_at(T0 + 2 * S).unwrap();
    assert_eq!((prior.source, prior.chain, prior.position), (PriorSource::External, 0, place(0.0)));
    close(prior.radius_m, 300.0 + 50.0);
    // A fix in between starts the count anew.
    tracker.record(T0 + 2 * S, 6, &fix(71.0, 3.0, Some(prior)));
    tracker.record(T0 + 2 * S, 7, &no_fix());
    assert_eq!(tracker.prior_at(T0 + 3 * S).unwrap().source, PriorSource::OwnFix);
}

#[test]
fn thirty_seconds_fall_back_to_the_external_prior() {
    let mut tracker = Tracker::new(settings());
    tracker.report(radius(T0, 0.0, 300.0));
    tracker.record(T0, 0, &fix(70.0, 3.0, None));
    assert_eq!(tracker.prior_at(T0 + 30 * S).unwrap().source, PriorSource::OwnFix);
    let prior = tracker.prior_at(T0 + 31 * S).unwrap();
    assert_eq!(prior.source, PriorSource::External);
    close(prior.radius_m, 300.0 + 31.0 * 25.0);
}

#[test]
fn lost_without_an_external_prior_is_no_prior() {
    let mut tracker = tracker();
    tracker.record(T0, 0, &fix(70.0, 3.0, None));
    assert!(tracker.prior_at(T0 + S).is_ok());
    assert_eq!(tracker.prior_at(T0 + 31 * S).unwrap_err().reason, Reason::NoPrior);
}

#[test]
fn a_newer_external_prior_wins_over_the_own_fix() {
    let mut tracker = tracker();
    tracker.report(radius(T0, 0.0, 512.0));
    tracker.record(T0, 0, &fix(70.0, 3.0, None));
    assert_eq!(tracker.prior_at(T0 + S).unwrap().source, PriorSource::OwnFix, "the fix used that prior: it is newer");
    tracker.report(radius(T0 + S, 200.0, 400.0));
    let prior = tracker.prior_at(T0 + S).unwrap();
    assert_eq!((prior.source, prior.radius_m), (PriorSource::External, 400.0));
    // Even with the stamp of a frame already answered, and before it: what comes with the exposure's stamp holds for it.
    tracker.record(T0 + S, 1, &fix(75.0, 3.0, None));
    tracker.report(radius(T0 + S, 210.0, 400.0));
    assert_eq!(tracker.prior_at(T0 + S).unwrap().position, place(210.0));
    tracker.report(radius(T0 - 5 * S, -10.0, 400.0));
    assert_eq!(tracker.prior_at(T0 - 5 * S).unwrap().position, place(-10.0));
}

#[test]
fn the_external_prior_is_known_beside_the_own_fix() {
    let mut tracker = tracker();
    assert_eq!(tracker.external_at(T0), None);
    tracker.report(sigma(T0, 0.0, 10.0));
    tracker.record(T0, 40, &fix(70.0, 3.0, None));
    // An echo is no external prior.
    tracker.report(PriorReport { fix_seq: Some(40), ..sigma(T0 + S, 90.0, 2.0) });
    let prior = tracker.external_at(T0 + 2 * S).unwrap();
    assert_eq!((prior.source, prior.position, prior.age_s), (PriorSource::External, place(0.0), Some(2.0)));
    close(prior.radius_m, 180.0);
    assert_eq!(tracker.external_at(T0 + 601 * S), None, "stale");
}

#[test]
fn of_two_priors_one_that_can_be_searched_is_taken() {
    let after = T0 + 49 * S / 10;
    let own_then = |external_m: f64| {
        let mut tracker = tracker();
        tracker.report(radius(T0, 0.0, external_m));
        tracker.record(T0, 0, &fix(70.0, 3.0, None));
        tracker
    };
    // By then the own fix is 3 x (50 + 25 x 4.9) = 517.5 m wide, which D_C = 512 m cannot hold.
    assert_eq!(own_then(400.0).prior_at(after).unwrap().source, PriorSource::OwnFix, "522.5 m is no better");
    assert_eq!(own_then(380.0).prior_at(after).unwrap().source, PriorSource::External, "502.5 m can be searched");
    let mut tracker = own_then(400.0);
    // And a newer external prior that is hopelessly wide does not cost the track.
    tracker.report(radius(T0 + S, 0.0, 5000.0));
    assert_eq!(tracker.prior_at(T0 + S).unwrap().source, PriorSource::OwnFix);
}

#[test]
fn an_echo_is_own_influence_not_an_external_prior() {
    let mut tracker = tracker();
    tracker.report(radius(T0, 0.0, 512.0));
    let first = tracker.prior_at(T0).unwrap();
    tracker.record(T0, 40, &fix(70.0, 3.0, Some(first)));
    let echo = PriorReport { fix_seq: Some(40), ..sigma(T0 + 2 * S, 90.0, 2.0) };
    assert!(tracker.report(echo));
    let prior = tracker.prior_at(T0 + 2 * S).unwrap();
    assert_eq!((prior.source, prior.chain, prior.position), (PriorSource::OwnFix, 2, place(90.0)));
    assert_eq!(prior.sigma_m, Some(50.0), "an echo does not vouch for what it echoes");
    let bound = PriorReport { fix_seq: Some(40), ..radius(T0 + 3 * S, 95.0, 20.0) };
    assert!(tracker.report(bound));
    assert_eq!(tracker.prior_at(T0 + 3 * S).unwrap().radius_m, 150.0);
    // However long echoes go on, 30 s after the fix itself they are no more.
    assert!(tracker.report(PriorReport { fix_seq: Some(40), ..sigma(T0 + 31 * S, 500.0, 2.0) }));
    assert_eq!(tracker.prior_at(T0 + 31 * S).unwrap().source, PriorSource::External);
}

#[test]
fn an_echo_of_a_fix_given_up_grows_since_that_fix_and_comes_last() {
    let mut tracker = tracker();
    tracker.report(radius(T0, 0.0, 300.0));
    tracker.record(T0, 0, &fix(70.0, 3.0, None));
    for seq in 1..=5 {
        tracker.record(T0, seq, &no_fix());
    }
    let echo = |at_s: i64| PriorReport { fix_seq: Some(0), ..sigma(T0 + at_s * S, 90.0, 2.0) };
    assert!(tracker.report(echo(4)));
    assert_eq!(tracker.prior_at(T0 + 4 * S).unwrap().source, PriorSource::External, "400 m can be searched");
    // An external prior that cannot be searched any more gives way; 3 x (50 + 25 x 4 + 25) m can.
    tracker.report(radius(T0 + 4 * S, 0.0, 600.0));
    let prior = tracker.prior_at(T0 + 4 * S + S / 2).unwrap();
    assert_eq!((prior.source, prior.chain, prior.position), (PriorSource::OwnFix, 2, place(90.0)));
    close(prior.radius_m, 3.0 * (50.0 + 100.0 + 12.5));
    // It vouches for nothing, and a fix of our own goes first again.
    assert_eq!(tracker.external_at(T0 + 4 * S).unwrap().position, place(0.0));
    tracker.record(T0 + 4 * S, 6, &fix(71.0, 3.0, Some(prior)));
    assert!(tracker.report(echo(5)));
    assert_eq!(tracker.prior_at(T0 + 5 * S).unwrap().position, place(71.0));
    // However long the estimator has no newer fix of ours to state, it is heard.
    for seq in 7..=11 {
        tracker.record(T0 + 5 * S, seq, &no_fix());
    }
    let bound = PriorReport { fix_seq: Some(0), ..radius(T0 + 900 * S, 95.0, 200.0) };
    assert!(tracker.report(bound));
    let prior = tracker.prior_at(T0 + 900 * S).unwrap();
    assert_eq!((prior.position, prior.radius_m), (place(95.0), 200.0 + 25.0 * 900.0));
}

#[test]
fn an_echo_of_a_fix_that_is_forgotten_is_refused() {
    let mut tracker = tracker();
    for seq in 100..200 {
        tracker.record(T0, seq, &fix(70.0, 3.0, None));
    }
    let echo = |seq| PriorReport { fix_seq: Some(seq), ..sigma(T0, 90.0, 60.0) };
    assert!(!tracker.report(echo(135)), "of the 64 kept 136 is the oldest");
    assert!(tracker.report(echo(136)));
}

#[test]
fn an_echo_of_an_unknown_fix_is_not_believed_after_a_loss() {
    let mut tracker = tracker();
    let echo = PriorReport { fix_seq: Some(9000), ..sigma(T0, 90.0, 60.0) };
    for seq in 1..=5 {
        tracker.record(T0, seq, &no_fix());
    }
    assert!(tracker.report(echo), "frames before the first prior lose nothing");
    for seq in 6..=9 {
        tracker.record(T0, seq, &no_fix());
    }
    assert!(tracker.report(echo));
    tracker.record(T0, 10, &no_fix());
    assert!(!tracker.report(echo));
    assert_eq!(tracker.prior_at(T0).unwrap_err().reason, Reason::NoPrior);
}

#[test]
fn an_echo_of_an_unknown_fix_counts_as_one_deep() {
    let mut tracker = tracker();
    assert!(tracker.report(PriorReport { fix_seq: Some(9000), ..sigma(T0, 90.0, 60.0) }));
    let prior = tracker.prior_at(T0).unwrap();
    assert_eq!((prior.source, prior.chain, prior.sigma_m), (PriorSource::OwnFix, 1, Some(60.0)));
}

#[test]
fn order_of_arrival_does_not_matter_and_the_future_grows_too() {
    let mut tracker = tracker();
    tracker.report(radius(T0 + 10 * S, 10.0, 100.0));
    tracker.report(radius(T0 + 9 * S, 0.0, 100.0));
    assert_eq!(tracker.prior_at(T0 + 11 * S).unwrap().position, place(10.0));
    let prior = tracker.prior_at(T0 + 7 * S).unwrap();
    assert_eq!((prior.position, prior.age_s), (place(0.0), Some(-2.0)));
    close(prior.radius_m, 150.0);
}

#[test]
fn a_clock_that_steps_back_leaves_the_future_behind() {
    let mut tracker = tracker();
    for i in 0..500 {
        tracker.report(radius(T0 + 3600 * S + i * S, 0.0, 100.0));
    }
    assert_eq!(tracker.prior_at(T0).unwrap_err().reason, Reason::StalePrior);
    tracker.report(radius(T0, 5.0, 100.0));
    assert_eq!(tracker.prior_at(T0).unwrap().position, place(5.0));
}

#[test]
fn a_small_step_back_leaves_no_future_that_wins_by_stamp() {
    let mut tracker = tracker();
    for i in 0..30 {
        let (stamp_ns, east_m) = (T0 + i * S, 20.0 * i as f64);
        tracker.report(radius(stamp_ns, east_m, 100.0));
        tracker.record(stamp_ns, i as u64, &fix(east_m, 3.0, None));
    }
    // 10 s back, while the vehicle goes on: nothing of the last flight between T0 + 20 s and T0 + 30 s holds now.
    tracker.report(radius(T0 + 20 * S, 620.0, 100.0));
    tracker.record(T0 + 20 * S, 30, &fix(620.0, 3.0, None));
    for i in 20..30 {
        let prior = tracker.prior_at(T0 + i * S).unwrap();
        assert_eq!(prior.position, place(620.0));
        assert_eq!(tracker.external_at(T0 + i * S).unwrap().position, place(620.0));
    }
}

#[test]
fn numbers_that_are_none_are_refused() {
    let mut tracker = tracker();
    for bad in [f64::NAN, f64::INFINITY, 0.0, -1.0] {
        assert!(!tracker.report(radius(T0, 0.0, bad)));
        assert!(!tracker.report(sigma(T0, 0.0, bad)));
    }
    for (lat_deg, lon_deg) in [(f64::NAN, 0.0), (91.0, 0.0), (0.0, f64::INFINITY), (0.0, 181.0)] {
        assert!(!tracker.report(PriorReport { position: LatLon { lat_deg, lon_deg }, ..radius(T0, 0.0, 10.0) }));
    }
    tracker.record(T0, 0, &fix(0.0, f64::NAN, None));
    assert_eq!(tracker.prior_at(T0).unwrap_err().reason, Reason::NoPrior);
    for stamp_ns in [i64::MIN, 0, i64::MAX] {
        tracker.report(radius(stamp_ns, 0.0, 10.0));
        tracker.record(stamp_ns, 1, &fix(0.0, 1.0, None));
        assert!(tracker.prior_at(stamp_ns).is_ok());
        assert!(tracker.prior_at(i64::MIN).is_ok() || stamp_ns != i64::MIN);
    }
}

#[test]
fn a_prior_never_shrinks_with_age() {
    let mut tracker = tracker();
    tracker.report(sigma(T0, 0.0, 20.0));
    let mut last = 0.0_f64;
    for step in 0..100 {
        let radius_m = tracker.prior_at(T0 + step * S / 10).unwrap().radius_m;
        assert!(radius_m >= last.max(60.0));
        last = radius_m;
    }
}
