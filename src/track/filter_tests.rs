//! The filter against a flight with known truth.

use super::*;
use crate::bus::MapId;
use crate::flight::noise::Dice;
use crate::locate::{Answer, Fix};

const S: i64 = 1_000_000_000;
const HOME: LatLon = LatLon { lat_deg: 25.2, lon_deg: 55.3 };

fn settings() -> TrackSettings {
    crate::config::Settings::defaults().unwrap().track
}

fn fix(stamp_ns: i64, seq: u64, at: Enu, sigma_m: f64) -> FixMessage {
    let answer = Answer::bare(Ok(Fix::plain(HOME.offset(at), sigma_m)), None);
    FixMessage::new(stamp_ns, seq, &answer, "b", &MapId { name: "m".into(), digest: "0".into() })
}

/// 20 m/s to the north-east, a fix a second, 5 m per axis.
fn flight(seconds: i64, dice: &mut Dice) -> Vec<(Enu, FixMessage)> {
    (0..seconds)
        .map(|i| {
            let truth = Enu { east_m: 12.0 * i as f64, north_m: 16.0 * i as f64 };
            let seen = Enu { east_m: truth.east_m + 5.0 * dice.normal(), north_m: truth.north_m + 5.0 * dice.normal() };
            (truth, fix(i * S, i as u64, seen, 5.0))
        })
        .collect()
}

fn error(at: (f64, f64), truth: Enu) -> Enu {
    let position = LatLon { lat_deg: at.0, lon_deg: at.1 };
    HOME.offset(truth).enu_to(position)
}

#[test]
fn it_is_better_than_its_fixes_and_knows_how_good() {
    let mut dice = Dice::new(1, 0);
    let (mut raw, mut now, mut lagged, mut nees, mut count) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for _ in 0..20 {
        let mut filter = TrackFilter::new(settings());
        let flight = flight(40, &mut dice);
        for (i, (truth, message)) in flight.iter().enumerate() {
            let Some(track) = filter.take(message) else { continue };
            if i < 15 {
                continue;
            }
            let square = |e: Enu| e.east_m * e.east_m + e.north_m * e.north_m;
            raw += square(error((message.lat_deg.unwrap(), message.lon_deg.unwrap()), *truth));
            let off = error((track.lat_deg, track.lon_deg), *truth);
            now += square(off);
            let c = Matrix2::from(track.covariance_enu_m2).try_inverse().unwrap();
            let off = Vector2::new(off.east_m, off.north_m);
            nees += (off.transpose() * c * off)[(0, 0)];
            let back = usize::try_from(track.lagged.fix_seq).unwrap();
            assert_eq!(back, i - settings().track_lag_fixes as usize);
            lagged += square(error((track.lagged.lat_deg, track.lagged.lon_deg), flight[back].0));
            count += 1.0;
        }
    }
    assert!(now < 0.8 * raw && lagged < 0.7 * now, "{raw} {now} {lagged}");
    // 2 degrees of freedom; a straight flight is calmer than the filter allows for.
    let nees = nees / count;
    assert!((1.2..2.4).contains(&nees), "{nees}");
}

#[test]
fn an_outlier_is_left_out_and_a_new_place_is_taken_after_a_while() {
    let mut filter = TrackFilter::new(settings());
    for (_, message) in flight(10, &mut Dice::new(2, 0)) {
        assert!(filter.take(&message).is_some());
    }
    let on = |i: i64, east_m: f64| fix(i * S, i as u64, Enu { east_m: 12.0 * i as f64 + east_m, north_m: 16.0 * i as f64 }, 5.0);
    assert!(filter.take(&on(10, 200.0)).is_none());
    let back = filter.take(&on(11, 0.0)).unwrap();
    assert!(back.innovation_nees.unwrap() < settings().track_gate);
    let anew: Vec<_> = (12..15).map(|i| filter.take(&on(i, 900.0))).collect();
    assert!(anew[0].is_none() && anew[1].is_none());
    let begun = anew[2].clone().unwrap();
    assert_eq!((begun.innovation_nees, begun.lagged.fix_seq), (None, 14));
}

#[test]
fn what_neighbours_share_is_not_averaged_away() {
    let mut filter = TrackFilter::new(settings());
    let mut last = None;
    for i in 0..30 {
        let mut message = fix(i * S, i as u64, Enu::default(), 5.0);
        message.evidence.insert("sigma_map_m".into(), 4.0);
        last = filter.take(&message);
    }
    let last = last.unwrap();
    assert!(last.covariance_enu_m2[0][0] >= 16.0 && last.lagged.covariance_enu_m2[1][1] >= 16.0, "{last:?}");
}

#[test]
fn calibrated_is_what_rests_on_calibrated_fixes_alone() {
    let mut filter = TrackFilter::new(settings());
    let said: Vec<bool> = (0..14)
        .map(|i| {
            let calibrated = i != 3;
            filter.take(&FixMessage { calibrated, ..fix(i * S, i as u64, Enu::default(), 5.0) }).unwrap().calibrated
        })
        .collect();
    let lag = i64::from(settings().track_lag_fixes);
    let expected: Vec<bool> = (0..14).map(|i| !(3..=3 + lag).contains(&i)).collect();
    assert_eq!(said, expected);
}

#[test]
fn gaps_old_fixes_and_numbers_that_are_none() {
    let mut filter = TrackFilter::new(settings());
    assert!(filter.take(&fix(100 * S, 1, Enu::default(), 5.0)).is_some());
    assert!(filter.take(&fix(99 * S, 2, Enu::default(), 5.0)).is_none(), "older than the last");
    assert!(filter.take(&fix(100 * S, 3, Enu::default(), 5.0)).is_none(), "the same exposure");
    let after = filter.take(&fix(200 * S, 4, Enu { east_m: 2000.0, north_m: 0.0 }, 5.0)).unwrap();
    assert_eq!((after.innovation_nees, after.lagged.fix_seq), (None, 4), "a gap begins anew");
    assert!(filter.take(&fix(170 * S, 4, Enu::default(), 5.0)).is_none(), "30 s older than the last");
    // One that was stamped far ahead, or a clock that stepped back, silences nothing for long.
    assert!(filter.take(&fix(700 * S, 4, Enu::default(), 5.0)).is_some());
    let back = filter.take(&fix(201 * S, 4, Enu::default(), 5.0)).unwrap();
    assert_eq!((back.innovation_nees, back.stamp_ns), (None, 201 * S));
    for sigma_m in [f64::NAN, f64::INFINITY, 0.0] {
        assert!(filter.take(&fix(201 * S, 5, Enu::default(), sigma_m)).is_none());
    }
    for stamp_ns in [i64::MIN, i64::MAX, 0] {
        let _ = filter.take(&fix(stamp_ns, 6, Enu::default(), 5.0));
    }
    let mut no_fix = fix(300 * S, 7, Enu::default(), 5.0);
    no_fix.lat_deg = None;
    assert!(filter.take(&no_fix).is_none());
}
