//! The built binary under test: its configuration, a service manager that listens, and a Python peer.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Output, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// Longer than anything takes on a busy machine.
pub const LONG: Duration = Duration::from_secs(120);

/// Path from the repository's root.
pub fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// Python with the packages of `requirements.txt`; where it is missing the test says so and is skipped.
pub fn python() -> Option<PathBuf> {
    let python = root(".venv/bin/python");
    if python.exists() {
        return Some(python);
    }
    eprintln!("skipped: no .venv/bin/python (`make venv` makes it)");
    None
}

/// Map, bundle and frame, made once for all tests of this binary.
pub struct Tiny {
    pub folder: PathBuf,
    pub lat_deg: f64,
    pub lon_deg: f64,
}

pub fn tiny(python: &Path) -> &'static Tiny {
    static TINY: OnceLock<Tiny> = OnceLock::new();
    TINY.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("tiny-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        let made = Command::new(python).arg(root("tests/peers/tiny.py")).arg(&folder).status().unwrap();
        assert!(made.success());
        let at: Value = serde_json::from_slice(&std::fs::read(folder.join("frame.json")).unwrap()).unwrap();
        Tiny { lat_deg: at["lat_deg"].as_f64().unwrap(), lon_deg: at["lon_deg"].as_f64().unwrap(), folder }
    })
}

/// ONNX Runtime's library in the virtual environment.
pub fn onnxruntime() -> PathBuf {
    let lib = root(".venv/lib");
    let capi = std::fs::read_dir(&lib)
        .unwrap()
        .flatten()
        .map(|python| python.path().join("site-packages/onnxruntime/capi"))
        .find(|capi| capi.is_dir())
        .unwrap();
    let mut found: Vec<PathBuf> = std::fs::read_dir(capi).unwrap().flatten().map(|file| file.path()).collect();
    found.retain(|file| file.file_name().unwrap().to_str().unwrap().starts_with("libonnxruntime.so"));
    found.sort();
    found.pop().unwrap()
}

/// A loopback port that was free a moment ago.
pub fn free_port() -> u16 {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// `nightfix` with these arguments, ONNX Runtime named.
pub fn nightfix(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nightfix"));
    command.arg("--onnxruntime").arg(onnxruntime()).args(arguments);
    command.env_remove("NOTIFY_SOCKET").env_remove("WATCHDOG_USEC").env_remove("WATCHDOG_PID").env_remove("RUST_LOG");
    command
}

/// Writes a configuration beside the fixture: `map.path` and `bundle.path` relative to it, then `more`.
pub fn configuration(tiny: &Tiny, name: &str, more: &str) -> PathBuf {
    let file = tiny.folder.join(name);
    let text = format!("map.path = \"map.tif\"\nbundle.path = \"bundle\"\n{more}\n");
    std::fs::write(&file, text).unwrap();
    file
}

/// Runs to the end.
pub fn output(command: &mut Command) -> Output {
    command.stdin(Stdio::null()).output().unwrap()
}

/// A service manager: the datagrams of `sd_notify`, taken as they come (the kernel keeps only a few).
pub struct Manager {
    said: Receiver<String>,
    _folder: tempfile::TempDir,
    pub path: PathBuf,
}

impl Manager {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        let (tell, said) = channel();
        std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(length) = socket.recv(&mut buffer) {
                if tell.send(String::from_utf8(buffer[..length].to_vec()).unwrap()).is_err() {
                    break;
                }
            }
        });
        Self { said, _folder: folder, path }
    }
    /// The next datagram within `wait`.
    pub fn next(&self, wait: Duration) -> Option<String> {
        self.said.recv_timeout(wait).ok()
    }
    /// Waits for a datagram that has this line.
    pub fn expect(&self, line: &str) -> String {
        let until = Instant::now() + LONG;
        while let Some(text) = self.next(until.saturating_duration_since(Instant::now())) {
            if text.lines().any(|l| l == line) {
                return text;
            }
        }
        panic!("the service never said {line}");
    }
}

/// A running service; killed when dropped.
pub struct Service {
    pub child: Child,
    log: PathBuf,
}

impl Service {
    pub fn start(configuration: &Path, manager: &Manager, watchdog: Duration) -> Self {
        let log = configuration.with_extension("log");
        let child = nightfix(&["run", "--config", configuration.to_str().unwrap()])
            .env("NOTIFY_SOCKET", &manager.path)
            .env("WATCHDOG_USEC", watchdog.as_micros().to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(std::fs::File::create(&log).unwrap())
            .spawn()
            .unwrap();
        Self { child, log }
    }
    pub fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }
    pub fn signal(&self, name: &str) {
        assert!(Command::new("kill").args([&format!("-{name}"), &self.child.id().to_string()]).status().unwrap().success());
    }
    /// Waits for its end: the exit code.
    pub fn exit_code(&mut self) -> Option<i32> {
        let until = Instant::now() + LONG;
        while Instant::now() < until {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("it does not end; its log:\n{}", self.log());
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("---- log of the service ----\n{}", self.log());
        }
    }
}

/// The Python peer; see `tests/peers/talk.py`.
pub struct Peer {
    child: Child,
    orders: ChildStdin,
    events: Receiver<Value>,
    /// Heard while waiting for something else.
    heard: Vec<Value>,
}

impl Peer {
    pub fn start(python: &Path, port: u16, vehicle: &str) -> Self {
        let mut child = Command::new(python)
            .arg(root("tests/peers/talk.py"))
            .args([&format!("tcp/127.0.0.1:{port}"), vehicle])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (tell, events) = channel();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                if tell.send(serde_json::from_str(&line).unwrap()).is_err() {
                    break;
                }
            }
        });
        let orders = child.stdin.take().unwrap();
        let mut peer = Self { child, orders, events, heard: Vec::new() };
        peer.wait_for("the peer's start", |event| event["event"] == "ready");
        peer
    }
    /// Stops it where it stands: it neither reads nor ends.
    pub fn pause(&self) {
        assert!(Command::new("kill").args(["-STOP", &self.child.id().to_string()]).status().unwrap().success());
    }
    fn order(&mut self, order: Value) {
        writeln!(self.orders, "{order}").unwrap();
    }
    pub fn put(&mut self, key: &str, payload: Value) {
        self.order(json!({"do": "put", "key": key, "payload": payload}));
    }
    pub fn frame(&mut self, attachment: Value, file: &Path) {
        self.order(json!({"do": "frame", "attachment": attachment, "file": file}));
    }
    pub fn frame_bytes(&mut self, attachment: Value, bytes: usize) {
        self.order(json!({"do": "frame", "attachment": attachment, "bytes": bytes}));
    }
    /// Asks for the last fix: the replies.
    pub fn get(&mut self) -> Vec<Value> {
        self.order(json!({"do": "get"}));
        let event = self.wait_for("replies", |event| event["event"] == "replies");
        event["replies"].as_array().unwrap().clone()
    }
    /// The first event, heard already or to come, that fits; it and only it is taken.
    pub fn wait_for(&mut self, what: &str, fits: impl Fn(&Value) -> bool) -> Value {
        self.wait_at_most(LONG, fits).unwrap_or_else(|| panic!("the peer never heard: {what}; heard: {:#?}", self.heard.last()))
    }
    pub fn wait_at_most(&mut self, wait: Duration, fits: impl Fn(&Value) -> bool) -> Option<Value> {
        if let Some(index) = self.heard.iter().position(&fits) {
            return Some(self.heard.remove(index));
        }
        let until = Instant::now() + wait;
        loop {
            let event = self.events.recv_timeout(until.saturating_duration_since(Instant::now())).ok()?;
            if fits(&event) {
                return Some(event);
            }
            self.heard.push(event);
        }
    }
    /// The answer to the frame of this stamp, as published.
    pub fn answer(&mut self, stamp_ns: i64) -> Value {
        let event = self.wait_for(&format!("an answer to {stamp_ns}"), |event| {
            is_sample(event, "/fix") && event["message"]["stamp_ns"] == stamp_ns
        });
        assert_eq!(event["encoding"], "application/json");
        event["message"].clone()
    }
    /// The first status from now on that fits.
    pub fn status(&mut self, what: &str, fits: impl Fn(&Value) -> bool) -> Value {
        self.heard.retain(|event| !is_sample(event, "/status"));
        self.wait_for(&format!("a status: {what}"), |event| is_sample(event, "/status") && fits(&event["message"]))["message"]
            .clone()
    }
}

fn is_sample(event: &Value, key: &str) -> bool {
    event["event"] == "sample" && event["key"].as_str().is_some_and(|k| k.ends_with(key))
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Local addresses of TCP sockets in state LISTEN that a process holds.
pub fn listening(pid: u32) -> Vec<String> {
    let held: Vec<String> = std::fs::read_dir(format!("/proc/{pid}/fd"))
        .unwrap()
        .flatten()
        .filter_map(|fd| {
            Some(std::fs::read_link(fd.path()).ok()?.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?.to_owned())
        })
        .collect();
    assert!(!held.is_empty(), "the process holds no socket at all: it cannot have been looked at");
    let mut found = Vec::new();
    for table in ["tcp", "tcp6", "udp", "udp6"] {
        let text = std::fs::read_to_string(format!("/proc/{pid}/net/{table}")).unwrap_or_default();
        for line in text.lines().skip(1) {
            let fields: Vec<&str> = line.split_whitespace().collect();
            // TCP: state 0A is LISTEN. UDP: an unconnected socket, state 07, receives from anyone.
            let open = if table.starts_with("tcp") { "0A" } else { "07" };
            if fields[3] == open && held.iter().any(|inode| inode == fields[9]) {
                found.push(format!("{table} {}", fields[1]));
            }
        }
    }
    found
}
