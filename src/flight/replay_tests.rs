use super::*;
use crate::config::{Settings, TrackSettings};
use crate::geo::{Enu, LatLon};
use crate::locate::{Fix, StageName, WindowInfo};
use std::path::Path;

const HOME: LatLon = LatLon { lat_deg: 25.2, lon_deg: 55.3 };

/// Answers with the prior's position, moved 3 m east; `no_fix` as the localizer would without a prior or a frame.
struct Echo;

impl Locate for Echo {
    fn locate(&mut self, query: &Query<'_>) -> Answer {
        let outcome = match (&query.prior, &query.frame) {
            (Err(no_fix), _) => Err(no_fix.clone()),
            (_, Err(error)) => Err(NoFix { reason: Reason::BadFrame, detail: error.to_string() }),
            (_, Ok(frame)) if decode(frame.bytes, frame.encoding, None).is_err() || query.pose.gsd_m.is_none() => {
                Err(NoFix { reason: Reason::BadFrame, detail: "bad".into() })
            }
            (Ok(prior), Ok(_)) => Ok(Fix {
                position: prior.position.offset(Enu { east_m: 3.0, north_m: 0.0 }),
                covariance_enu_m2: [[1.0, 0.0], [0.0, 1.0]],
                radius95_m: 2.5,
                radius999_m: 4.0,
                calibrated: false,
                p_over_25m: None,
                yaw_deg: 0.0,
                scale: 1.0,
                stage: StageName::Refine,
                homography: [[1.0, 0.0, 512.0], [0.0, 1.0, 512.0], [0.0, 0.0, 1.0]],
            }),
        };
        let prior = query.prior.clone().ok();
        let window = prior.map(|p| WindowInfo { centre: p.position, width_m: 1536.0, map_affine: [0.0; 6] });
        Answer {
            outcome,
            prior,
            withheld: None,
            bundle: None,
            searched: false,
            window,
            evidence: Default::default(),
            latency_ms: [("total".to_owned(), 1.0)].into(),
        }
    }
    fn identity(&self) -> (String, MapId) {
        ("echo".into(), MapId { name: "m.tif".into(), digest: "00".into() })
    }
}

/// A flight with these rows; `good.png` and `good2.png` to `good5.png` are frames, `torn.png` is none, others are absent.
fn flight(folder: &Path, rows: &str) -> Flight {
    let header =
        "file,stamp_ns,gsd_m,yaw_deg,prior_lat_deg,prior_lon_deg,prior_sigma_m,prior_radius_m,truth_lat_deg,truth_lon_deg";
    std::fs::write(folder.join("flight.toml"), "").expect("flight.toml");
    std::fs::write(folder.join("poses.csv"), format!("{header}\n{rows}")).expect("poses.csv");
    for (i, name) in (0..).zip(["good.png", "good2.png", "good3.png", "good4.png", "good5.png"]) {
        let picture = image::GrayImage::from_fn(8, 8, |x, y| image::Luma([(x * 31 + y * 7 + i) as u8]));
        picture.save(folder.join(name)).expect("a frame");
    }
    std::fs::write(folder.join("torn.png"), b"\x89PNG\r\n\x1a\nno more").expect("a torn frame");
    Flight::open(folder).expect("a flight")
}

fn budget() -> BudgetSettings {
    Settings::defaults().expect("defaults").budget
}

fn run(flight: &Flight) -> (Vec<serde_json::Value>, ReplayReport) {
    let settings = TrackSettings { frozen_frames: 3, ..Settings::defaults().expect("defaults").track };
    let (tracker, guard) = (Tracker::new(settings.clone()), Guard::new(settings, true));
    let mut lines = Vec::new();
    let report = replay(flight, &mut Echo, &budget(), tracker, guard, |line| {
        lines.push(serde_json::to_value(line)?);
        Ok::<_, serde_json::Error>(())
    });
    (lines, report.expect("a replay"))
}

#[test]
fn one_line_per_row_in_order_with_file_and_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let rows = "good.png,10,1,0,25.2,55.3,,500,25.2,55.3\nabsent.png,20,1,0,25.2,55.3,,500,25.2,55.3\ngood.png,30,1,0,25.2,55.3,,500,,\n";
    let (lines, report) = run(&flight(folder.path(), rows));
    let [first, second, third] = lines.as_slice() else { panic!("three lines, found {}", lines.len()) };
    assert_eq!(
        (&first["file"], &first["stamp_ns"], &first["seq"], &first["status"]),
        (&"good.png".into(), &10.into(), &0.into(), &"fix".into())
    );
    assert!((first["error_m"].as_f64().expect("a number") - 3.0).abs() < 1e-6);
    assert_eq!((&second["file"], &second["reason"], &second["seq"]), (&"absent.png".into(), &"bad_frame".into(), &1.into()));
    assert!(second["error_m"].is_null() && second.get("error_m").is_some() && second.get("lat_deg").is_none());
    assert!(third["status"] == "fix" && third["error_m"].is_null() && third.get("error_m").is_some());
    assert_eq!((report.unreadable, report.metrics.frames, report.metrics.fixes, report.metrics.scored), (1, 3, 2, 1));
}

#[test]
fn unreadable_frames_are_data_loss_but_a_poor_pose_is_not() {
    let folder = tempfile::tempdir().expect("a folder");
    let (lines, report) = run(&flight(folder.path(), "torn.png,10,1,0,25.2,55.3,,500,,\ngood.png,20,,0,25.2,55.3,,500,,\n"));
    assert!(lines.iter().all(|l| l["reason"] == "bad_frame"));
    assert_eq!(report.unreadable, 1);
}

#[test]
fn no_line_says_where_the_flight_lies() {
    let folder = tempfile::tempdir().expect("a folder");
    let (lines, _) = run(&flight(folder.path(), "absent.png,10,1,0,25.2,55.3,,500,,\ntorn.png,20,1,0,25.2,55.3,,500,,\n"));
    let text = serde_json::to_string(&lines).expect("JSON");
    assert!(!text.contains(&*folder.path().to_string_lossy()), "{text}");
}

#[test]
fn a_row_s_own_prior_first_then_the_last_fix() {
    let folder = tempfile::tempdir().expect("a folder");
    let rows = "good.png,1000000000,1,0,,,,,,\n\
                good2.png,2000000000,1,0,25.2,55.3,,500,,\n\
                good3.png,3000000000,1,0,,,,,,\n\
                good4.png,4000000000,1,0,25.2,55.3,40,,,\n\
                good5.png,5000000000,1,0,25.2,55.3,,,,\n";
    let (lines, _) = run(&flight(folder.path(), rows));
    let [none, own_row, chained, sigma, widthless] = lines.as_slice() else { panic!("five lines") };
    assert_eq!(none["reason"], "no_prior");
    assert_eq!(
        (&own_row["prior"]["source"], &own_row["prior"]["radius_m"], &own_row["prior"]["chain"]),
        (&"external".into(), &500.0.into(), &0.into())
    );
    // The last fix, 3 m east of the prior: at least 50 m per axis, grown by a second at 25 m/s.
    assert_eq!((&chained["prior"]["source"], &chained["prior"]["chain"]), (&"own_fix".into(), &1.into()));
    assert_eq!((&chained["prior"]["sigma_m"], &chained["prior"]["radius_m"]), (&75.0.into(), &225.0.into()));
    let at =
        LatLon { lat_deg: chained["prior"]["lat_deg"].as_f64().unwrap(), lon_deg: chained["prior"]["lon_deg"].as_f64().unwrap() };
    assert!((at.distance_m(HOME) - 3.0).abs() < 1e-6);
    assert_eq!(
        (&sigma["prior"]["sigma_m"], &sigma["prior"]["radius_m"], &sigma["prior"]["source"]),
        (&40.0.into(), &120.0.into(), &"external".into())
    );
    assert_eq!(widthless["reason"], "no_prior");
}

/// As [`Echo`], with the tilt's term of an attitude that is known.
struct Tilted;

impl Locate for Tilted {
    fn locate(&mut self, query: &Query<'_>) -> Answer {
        let mut answer = Echo.locate(query);
        answer.evidence.insert("tilt_lever_m".to_owned(), 400.0);
        answer.evidence.insert("sigma_tilt_m".to_owned(), 400.0 * 0.5_f64.to_radians());
        answer.evidence.insert("pitch_deg".to_owned(), query.pose.pitch_deg.unwrap_or(f64::NAN));
        answer
    }
    fn identity(&self) -> (String, MapId) {
        Echo.identity()
    }
}

#[test]
fn a_tilted_mount_without_an_attitude_counts_and_its_tilt_is_not_known() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut flight =
        flight(folder.path(), "good.png,1000000000,1,0,25.2,55.3,,500,,\ngood2.png,2000000000,1,0,25.2,55.3,,500,,\n");
    flight.camera.mount_pitch_deg = 10.0;
    flight.rows[1].pose = crate::thermal::Pose { pitch_deg: Some(2.0), roll_deg: Some(0.0), ..flight.rows[1].pose };
    let settings = Settings::defaults().expect("defaults").track;
    let (tracker, guard) = (Tracker::new(settings.clone()), Guard::new(settings, true));
    let mut seen = Vec::new();
    let report = replay(&flight, &mut Tilted, &budget(), tracker, guard, |line| {
        let tenths = |name: &str| (line.message.evidence[name] * 10.0).round() as i64;
        seen.push((tenths("pitch_deg"), tenths("sigma_tilt_m")));
        Ok::<_, ()>(())
    });
    assert!(report.is_ok());
    assert_eq!(seen, [(100, 140), (120, 35)]);
}

#[test]
fn two_runs_give_the_same_lines() {
    let folder = tempfile::tempdir().expect("a folder");
    let flight = flight(folder.path(), "good.png,10,1,0,25.2,55.3,,500,25.2,55.3\ngood.png,20,1,0,,,,,25.2,55.3\n");
    assert_eq!(run(&flight).0, run(&flight).0);
}

#[test]
fn an_error_of_the_writer_ends_the_replay() {
    let folder = tempfile::tempdir().expect("a folder");
    let flight = flight(folder.path(), "good.png,10,1,0,25.2,55.3,,500,,\ngood.png,20,1,0,,,,,,\n");
    let settings = TrackSettings { frozen_frames: 3, ..Settings::defaults().expect("defaults").track };
    let (tracker, guard) = (Tracker::new(settings.clone()), Guard::new(settings, true));
    let mut count = 0;
    let result = replay(&flight, &mut Echo, &budget(), tracker, guard, |_| {
        count += 1;
        Err("full")
    });
    assert_eq!((result, count), (Err("full"), 1));
}

#[test]
fn the_guard_stands_between_the_localizer_and_the_tracker() {
    let folder = tempfile::tempdir().expect("a folder");
    // The same file three times; then another, and the file again.
    let rows = "good.png,1000000000,1,0,25.2,55.3,,500,,\n\
                good.png,2000000000,1,0,,,,,,\n\
                good.png,3000000000,1,0,,,,,,\n\
                good2.png,4000000000,1,0,,,,,,\n\
                good.png,5000000000,1,0,,,,,,\n";
    let flight = flight(folder.path(), rows);
    let (lines, report) = run(&flight);
    let statuses: Vec<_> = lines.iter().map(|line| line["status"].as_str().unwrap()).collect();
    assert_eq!(statuses, ["fix", "fix", "no_fix", "fix", "no_fix"]);
    assert_eq!(lines[2]["reason"], "held_back");
    assert!(lines[2]["detail"].as_str().unwrap().contains("frozen") && lines[2].get("lat_deg").is_none());
    // Frame 4 starts from the fix of frame 2: what was held back is no prior.
    assert_eq!((&lines[3]["prior"]["chain"], &lines[3]["prior"]["age_s"]), (&2.into(), &2.0.into()));
    assert_eq!(report.metrics.no_fix[&Reason::HeldBack], 2);

    let settings = TrackSettings { frozen_frames: 3, ..Settings::defaults().expect("defaults").track };
    let (tracker, guard) = (Tracker::new(settings.clone()), Guard::new(settings, false));
    let report = replay(&flight, &mut Echo, &budget(), tracker, guard, |_| Ok::<_, ()>(())).expect("a replay");
    assert_eq!(report.metrics.fixes, 5, "gates off");
}
