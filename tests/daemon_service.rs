//! `nightfix run` as it is built, with a Python peer in another process and a service manager that listens.

// Helpers stand outside `#[test]` functions, where clippy.toml's allowances for tests do not reach.
#![allow(clippy::expect_used, clippy::panic, clippy::print_stderr, clippy::unwrap_used)]

mod service;

use serde_json::{Value, json};
use service::{Manager, Peer, Service, Tiny, configuration, free_port, listening, nightfix, output, python, tiny};
use std::path::PathBuf;
use std::time::{Duration, Instant};

const S: i64 = 1_000_000_000;
const T0: i64 = 1_700_000_000 * S;

/// A service that connects to `port`, where a peer may or may not be.
fn start(tiny: &Tiny, name: &str, port: u16, more: &str, watchdog: Duration) -> (Service, Manager) {
    let text = format!("vehicle.name = \"{name}\"\nzenoh.connect.endpoints = [\"tcp/127.0.0.1:{port}\"]\n{more}");
    let configuration = configuration(tiny, &format!("{name}.toml"), &text);
    let manager = Manager::new();
    (Service::start(&configuration, &manager, watchdog), manager)
}

fn prior(tiny: &Tiny, stamp_ns: i64) -> Value {
    json!({"stamp_ns": stamp_ns, "lat_deg": tiny.lat_deg, "lon_deg": tiny.lon_deg, "radius_m": 300.0})
}

fn attachment(stamp_ns: i64) -> Value {
    json!({"stamp_ns": stamp_ns, "encoding": "png", "width": 640, "height": 512, "gsd_m": 1.0, "yaw_deg": 0.0})
}

fn frame_file(tiny: &Tiny) -> PathBuf {
    tiny.folder.join("frame.png")
}

/// The frame with one pixel changed: a live camera never gives the same picture twice.
fn picture(tiny: &Tiny, number: u8) -> PathBuf {
    let mut image = image::open(frame_file(tiny)).unwrap();
    let path = tiny.folder.join(format!("frame-{number}.png"));
    image::GenericImage::put_pixel(&mut image, 0, 0, image::Rgba([number, number, number, 255]));
    image.save(&path).unwrap();
    path
}

/// Ends it as systemd does.
fn stop(mut service: Service, manager: &Manager) {
    service.signal("TERM");
    manager.expect("STOPPING=1");
    assert_eq!(service.exit_code(), Some(0), "{}", service.log());
}

#[test]
fn a_flight_of_the_service_from_start_to_stop() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let port = free_port();
    let (mut service, manager) = start(tiny, "whole", port, "daemon.deadline_ms = 60000", Duration::from_secs(1));

    // Ready with nobody there, listening on nothing.
    let ready = manager.expect("READY=1");
    assert!(ready.contains("STATUS=idle"), "{ready}");
    assert_eq!(listening(service.child.id()), Vec::<String>::new());

    // Three watchdog periods without a peer and without a frame: alive, and pinging more often than once a period.
    let until = Instant::now() + Duration::from_secs(3);
    let mut pings = 0;
    while let Some(text) = manager.next(until.saturating_duration_since(Instant::now())) {
        pings += usize::from(text.lines().any(|line| line == "WATCHDOG=1"));
    }
    assert!(pings >= 6, "{pings} pings in three periods");
    assert!(service.is_running());

    // A peer comes later: it is found, and finds us alive.
    let mut peer = Peer::start(&python, port, "whole");
    peer.wait_for("the liveliness token", |event| event["event"] == "alive" && event["kind"] == "PUT");

    // Before the first frame: no fix, and why.
    let replies = peer.get();
    assert_eq!(replies.len(), 1);
    assert_eq!(replies[0]["encoding"], "application/json");
    assert_eq!(replies[0]["key"], "nightfix/v1/whole/fix");
    let message = &replies[0]["message"];
    assert_eq!(
        (&message["status"], &message["reason"], &message["bundle"]),
        (&json!("no_fix"), &json!("no_prior"), &json!("tiny"))
    );
    for key in ["stamp_ns", "seq", "calibrated", "evidence", "map", "latency_ms", "age_ms"] {
        assert!(!message[key].is_null(), "{key}");
    }
    assert!(message.get("lat_deg").is_none());

    // A frame without a prior, then with one.
    peer.frame(attachment(T0), &frame_file(tiny));
    let answer = peer.answer(T0);
    assert_eq!((&answer["status"], &answer["reason"], &answer["seq"]), (&json!("no_fix"), &json!("no_prior"), &json!(1)));
    peer.put("prior", prior(tiny, T0 + S));
    peer.frame(attachment(T0 + S), &picture(tiny, 1));
    let answer = peer.answer(T0 + S);
    check_fix(&answer, tiny);
    assert_eq!((&answer["prior"]["source"], &answer["prior"]["chain"]), (&json!("external"), &json!(0)));

    // Who asks is told the same, and how old it is.
    let mut reply = peer.get().remove(0)["message"].clone();
    let age_ms = reply.as_object_mut().unwrap().remove("age_ms").unwrap();
    assert!(age_ms.as_u64().is_some_and(|ms| ms < 120_000));
    assert_eq!(reply, answer);

    // The next frame's prior is our own fix; its echo is known as such; the status says all of it.
    peer.frame(attachment(T0 + 2 * S), &picture(tiny, 2));
    let own = peer.answer(T0 + 2 * S);
    assert_eq!(
        (&own["prior"]["source"], &own["prior"]["chain"], &own["prior"]["sigma_m"]),
        (&json!("own_fix"), &json!(1), &json!(75.0))
    );
    let mut echo = prior(tiny, T0 + 3 * S);
    echo["fix_seq"] = own["seq"].clone();
    peer.put("prior", echo);
    peer.frame(attachment(T0 + 3 * S), &picture(tiny, 3));
    let echoed = peer.answer(T0 + 3 * S);
    assert_eq!((&echoed["prior"]["source"], &echoed["prior"]["chain"]), (&json!("own_fix"), &json!(3)));
    let status = peer.status("three fixes", |status| status["fixes"] == 3);
    assert_eq!((&status["state"], &status["bundle"], &status["provider"]), (&json!("fix"), &json!("tiny"), &json!("cpu")));
    assert_eq!(status["no_fix"], json!({"no_prior": 1}));
    assert_eq!(status["frames"], json!({"received": 4, "accepted": 4, "dropped": 0, "bad": 0}));
    assert_eq!(status["map"], answer["map"]);

    // Once a second.
    let first = peer.status("any", |_| true)["uptime_s"].as_f64().unwrap();
    let second = peer.status("any", |_| true)["uptime_s"].as_f64().unwrap();
    assert!((0.5..10.0).contains(&(second - first)), "{first} {second}");

    service.signal("TERM");
    let stopping = manager.expect("STOPPING=1");
    assert!(stopping.contains("STATUS=stopping"), "{stopping}");
    peer.wait_for("the token's end", |event| event["event"] == "alive" && event["kind"] == "DELETE");
    assert_eq!(service.exit_code(), Some(0), "{}", service.log());
}

/// Every field of the contract, with the values that the tiny bundle's answer leads to: the middle of the window.
fn check_fix(fix: &Value, tiny: &Tiny) {
    assert_eq!(fix["status"], "fix", "{fix:#}");
    assert!(fix.get("reason").is_none());
    // 1e-5 degrees is about a metre.
    assert!((fix["lat_deg"].as_f64().unwrap() - tiny.lat_deg).abs() < 1e-5);
    assert!((fix["lon_deg"].as_f64().unwrap() - tiny.lon_deg).abs() < 1e-5);
    assert!((fix["scale"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    assert_eq!((&fix["stage"], &fix["window_m"], &fix["calibrated"]), (&json!("coarse"), &json!(1024.0), &json!(false)));
    let [[a, b], [c, d]] = serde_json::from_value::<[[f64; 2]; 2]>(fix["covariance_enu_m2"].clone()).unwrap();
    assert!(a >= 25.0 && d >= 25.0 && a * d > b * c, "at least the bundle's 5 m per axis");
    assert!(fix["radius95_m"].as_f64().unwrap() < fix["radius999_m"].as_f64().unwrap());
    let homography: [[f64; 3]; 3] = serde_json::from_value(fix["homography"].clone()).unwrap();
    assert_eq!(homography[2][2], 1.0);
    assert!((homography[0][2] - 256.0).abs() < 1e-6 && (homography[0][0] - 1.0).abs() < 1e-9, "{homography:?}");
    assert_eq!(fix["window"]["width_m"], 1024.0);
    assert_eq!(fix["window"]["map_affine"].as_array().unwrap().len(), 6);
    assert_eq!(fix["map"]["name"], "map.tif");
    assert_eq!(fix["map"]["digest"].as_str().unwrap().len(), 64);
    assert_eq!(fix["prior"]["radius_m"], 300.0);
    assert!(fix["yaw_deg"].as_f64().is_some_and(|yaw| yaw.min(360.0 - yaw) < 1.0));
    assert!(!fix["latency_ms"].as_object().unwrap().is_empty());
}

#[test]
fn what_is_refused_is_counted_and_answered_where_its_stamp_can_be_read() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let port = free_port();
    let mut peer = Peer::start(&python, port, "refused");
    let more = "daemon.deadline_ms = 60000\ndaemon.max_frame_bytes = 2000000";
    let (service, manager) = start(tiny, "refused", port, more, Duration::from_secs(60));
    manager.expect("READY=1");
    peer.wait_for("the liveliness token", |event| event["event"] == "alive");
    peer.put("prior", prior(tiny, T0));

    // Without a readable stamp: counted only.
    for attachment in
        [Value::Null, json!("garbage"), json!("{\"stamp_ns\": 1e400}"), json!(" ".repeat(5000)), json!("[1,\"png\",640,512]")]
    {
        peer.frame(attachment, &frame_file(tiny));
    }
    peer.status("five bad frames", |status| status["frames"]["bad"] == 5);

    // With one: a bad frame, said so.
    let bad = |peer: &mut Peer, stamp_ns: i64| {
        let answer = peer.answer(stamp_ns);
        assert_eq!((&answer["status"], &answer["reason"]), (&json!("no_fix"), &json!("bad_frame")), "{answer:#}");
        assert!(answer.get("lat_deg").is_none());
        answer["detail"].as_str().unwrap().to_owned()
    };
    let mut unknown = attachment(T0);
    unknown["colour"] = json!("red");
    peer.frame(unknown, &frame_file(tiny));
    assert!(bad(&mut peer, T0).contains("colour"));
    peer.frame_bytes(attachment(T0 + 1), 2_000_001);
    assert!(bad(&mut peer, T0 + 1).contains("2000001 bytes"));
    peer.frame_bytes(attachment(T0 + 2), 1000);
    bad(&mut peer, T0 + 2);
    let mut raw = attachment(T0 + 3);
    raw["encoding"] = json!("y16le");
    peer.frame_bytes(raw, 7);
    bad(&mut peer, T0 + 3);

    // None of it harmed anything, nor did refused priors and attitudes.
    peer.put("prior", json!({"stamp_ns": T0, "lat_deg": 0, "lon_deg": 0, "radius_m": 1, "sigma_m": 1}));
    peer.put("prior", json!("nonsense"));
    peer.put("attitude", json!({"stamp_ns": T0, "roll_deg": 0, "pitch_deg": 500, "yaw_deg": 0}));
    peer.frame(attachment(T0 + 4), &frame_file(tiny));
    assert_eq!(peer.answer(T0 + 4)["status"], "fix");
    let status = peer.status("one fix", |status| status["fixes"] == 1);
    assert_eq!(status["frames"], json!({"received": 10, "accepted": 5, "dropped": 0, "bad": 5}));
    assert_eq!(status["no_fix"], json!({"bad_frame": 4}));
    assert_eq!(status["priors"], json!({"received": 3, "bad": 2}));
    assert_eq!(status["attitudes"], json!({"received": 1, "bad": 1}));
    assert!(service.log().contains("refused: "), "{}", service.log());
    stop(service, &manager);
}

#[test]
fn of_a_burst_the_newest_is_answered_and_the_rest_are_answered_or_counted() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let port = free_port();
    let mut peer = Peer::start(&python, port, "burst");
    let (service, manager) = start(tiny, "burst", port, "daemon.deadline_ms = 60000", Duration::from_secs(60));
    manager.expect("READY=1");
    peer.wait_for("the liveliness token", |event| event["event"] == "alive");
    peer.put("prior", prior(tiny, T0));
    let count = 40;
    // Stamps run backwards: newest is by arrival.
    for index in 0..count {
        peer.frame(attachment(T0 - index), &frame_file(tiny));
    }
    let last = peer.answer(T0 - (count - 1));
    assert_eq!(last["status"], "fix");
    let status = peer.status("all frames", |status| {
        let answered = status["fixes"].as_i64().unwrap()
            + status["no_fix"].as_object().unwrap().values().filter_map(Value::as_i64).sum::<i64>();
        status["frames"]["received"] == count && answered + status["frames"]["dropped"].as_i64().unwrap() == count
    });
    let dropped = status["frames"]["dropped"].as_i64().unwrap();
    assert!(dropped > 0, "nothing was dropped: the burst was no burst");
    assert_eq!(last["seq"], count - dropped, "one message for each frame answered");
    stop(service, &manager);
}

#[test]
fn an_answer_that_comes_too_late_is_no_fix() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let port = free_port();
    let mut peer = Peer::start(&python, port, "late");
    let (service, manager) = start(tiny, "late", port, "daemon.deadline_ms = 1", Duration::from_secs(60));
    manager.expect("READY=1");
    peer.wait_for("the liveliness token", |event| event["event"] == "alive");
    peer.put("prior", prior(tiny, T0));
    peer.frame(attachment(T0), &frame_file(tiny));
    let answer = peer.answer(T0);
    assert_eq!((&answer["status"], &answer["reason"]), (&json!("no_fix"), &json!("deadline")));
    assert!(answer.get("lat_deg").is_none() && answer.get("homography").is_none());
    stop(service, &manager);
}

#[test]
fn attitude_turns_the_frame() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let port = free_port();
    let mut peer = Peer::start(&python, port, "attitude");
    let more = "daemon.deadline_ms = 60000\ncamera.hfov_deg = 65.0\ncamera.mount_yaw_deg = 10.0";
    let (service, manager) = start(tiny, "attitude", port, more, Duration::from_secs(60));
    manager.expect("READY=1");
    peer.wait_for("the liveliness token", |event| event["event"] == "alive");
    peer.put("prior", prior(tiny, T0));
    // Neither yaw nor scale with the frame: unknown until an attitude says so, and again when that is too old.
    let bare = |stamp_ns: i64| json!({"stamp_ns": stamp_ns, "encoding": "png", "width": 640, "height": 512});
    peer.frame(bare(T0), &frame_file(tiny));
    assert_eq!(peer.answer(T0)["reason"], "bad_frame");
    let attitude = |at: i64, yaw: f64| json!({"stamp_ns": at, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": yaw, "agl_m": 500.0});
    peer.put("attitude", attitude(T0 + S, 350.0));
    peer.put("attitude", attitude(T0 + S + S / 10, 10.0));
    peer.frame(bare(T0 + S + S / 20), &frame_file(tiny));
    let answer = peer.answer(T0 + S + S / 20);
    assert_eq!(answer["status"], "fix", "{answer:#}");
    // 0 between 350 and 10, and the mount's 10; the tiny bundle sees no turn.
    assert!((answer["yaw_deg"].as_f64().unwrap() - 10.0).abs() < 1e-3, "{}", answer["yaw_deg"]);
    peer.frame(bare(T0 + 2 * S), &frame_file(tiny));
    assert_eq!(peer.answer(T0 + 2 * S)["reason"], "bad_frame");
    stop(service, &manager);
}

#[test]
fn a_stopped_subscriber_holds_up_nobody() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let (port, stuck_port) = (free_port(), free_port());
    let mut peer = Peer::start(&python, port, "stuck");
    let stuck = Peer::start(&python, stuck_port, "stuck");
    let text = format!(
        "vehicle.name = \"stuck\"\nzenoh.connect.endpoints = [\"tcp/127.0.0.1:{port}\", \"tcp/127.0.0.1:{stuck_port}\"]\n\
         daemon.deadline_ms = 60000"
    );
    let configuration = configuration(tiny, "stuck.toml", &text);
    let manager = Manager::new();
    let service = Service::start(&configuration, &manager, Duration::from_secs(60));
    manager.expect("READY=1");
    peer.wait_for("the liveliness token", |event| event["event"] == "alive");
    stuck.pause();
    peer.put("prior", prior(tiny, T0));
    for index in 0..20 {
        peer.frame(attachment(T0 + index), &frame_file(tiny));
        assert_eq!(peer.answer(T0 + index)["status"], "fix");
    }
    stop(service, &manager);
}

#[test]
fn what_cannot_start_says_why_and_exits_with_2() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let fails = |name: &str, text: &str, why: &str| {
        let file = tiny.folder.join(name);
        std::fs::write(&file, text).unwrap();
        for command in ["run", "check"] {
            let output = output(&mut nightfix(&[command, "--config", file.to_str().unwrap()]));
            let stderr = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{command} {text}: {stderr}");
            assert!(stderr.contains(why), "{command} {text}: {stderr}");
        }
    };
    let good = "map.path = \"map.tif\"\nbundle.path = \"bundle\"\n";
    fails("key.toml", "[daemon]\ndeadlin_ms = 3\n", "key.toml`:2:1: unknown field `deadlin_ms`");
    fails("map.toml", "bundle.path = \"bundle\"\n", "map.path");
    fails("bundle.toml", "map.path = \"map.tif\"\n", "bundle.path");
    fails("no-map.toml", "map.path = \"absent.tif\"\nbundle.path = \"bundle\"\n", "absent.tif");
    fails("no-bundle.toml", "map.path = \"map.tif\"\nbundle.path = \"absent\"\n", "absent");
    fails("provider.toml", &format!("{good}onnxruntime.provider = \"cuda\"\n"), "CUDA");
    let absent = output(&mut nightfix(&["run", "--config", "/nonexistent/nightfix.toml"]));
    assert_eq!(absent.status.code(), Some(2));
    let usage = output(&mut nightfix(&["run"]));
    assert_eq!(usage.status.code(), Some(2));
}

#[test]
fn check_reports_every_part() {
    let Some(python) = python() else { return };
    let tiny = tiny(&python);
    let file = configuration(tiny, "check.toml", "");
    let checked = output(&mut nightfix(&["check", "--config", file.to_str().unwrap()]));
    assert_eq!(checked.status.code(), Some(0), "{}", String::from_utf8_lossy(&checked.stderr));
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    assert_eq!(report["ok"], true);
    for part in ["configuration", "zenoh", "onnxruntime", "bundle", "map", "localizer"] {
        assert_eq!(report[part]["ok"], true, "{part}");
    }
    assert_eq!(report["bundle"]["name"], "tiny");
    let golden: Vec<&str> = report["bundle"]["golden"].as_array().unwrap().iter().filter_map(|g| g["array"].as_str()).collect();
    assert_eq!(golden, ["coarse_map.out.map_features", "coarse.out.displacement", "final", "homography"]);
    assert!((report["map"]["centre"]["lat_deg"].as_f64().unwrap() - tiny.lat_deg).abs() < 1e-4);

    // A graph that is not the one the manifest names is refused; the rest is checked all the same.
    let broken = configuration(tiny, "broken.toml", "");
    std::fs::write(&broken, "map.path = \"map.tif\"\nbundle.path = \"broken\"\n").unwrap();
    copy_broken(tiny);
    let checked = output(&mut nightfix(&["check", "--config", broken.to_str().unwrap()]));
    assert_eq!(checked.status.code(), Some(2));
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    assert_eq!((&report["ok"], &report["bundle"]["ok"], &report["map"]["ok"]), (&json!(false), &json!(false), &json!(true)));
    assert!(report["bundle"]["error"].as_str().unwrap().contains("coarse.onnx"), "{}", report["bundle"]["error"]);
}

/// A copy of the bundle with one byte of a graph changed.
fn copy_broken(tiny: &Tiny) {
    let to = tiny.folder.join("broken");
    std::fs::create_dir_all(&to).unwrap();
    for file in std::fs::read_dir(tiny.folder.join("bundle")).unwrap().flatten() {
        let mut bytes = std::fs::read(file.path()).unwrap();
        if file.file_name() == "coarse.onnx" {
            *bytes.last_mut().unwrap() ^= 1;
        }
        std::fs::write(to.join(file.file_name()), bytes).unwrap();
    }
}

#[test]
fn schemas_are_printed() {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_nightfix"));
    let one = output(command.args(["schema", "fix"]));
    assert_eq!(one.status.code(), Some(0));
    assert_eq!(one.stdout, std::fs::read(service::root("schemas/fix.json")).unwrap());
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_nightfix"));
    let all: Value = serde_json::from_slice(&output(command.arg("schema")).stdout).unwrap();
    assert_eq!(all.as_object().unwrap().len(), nightfix::bus::SCHEMA_NAMES.len());
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_nightfix"));
    assert_eq!(output(command.args(["schema", "fixes"])).status.code(), Some(2));
}
