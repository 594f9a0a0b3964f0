//! `deploy/nightfix.service`, as systemd's own tools see it.

// Helpers stand outside `#[test]` functions, where clippy.toml's allowances for tests do not reach.
#![allow(clippy::expect_used, clippy::panic, clippy::print_stderr, clippy::unwrap_used)]

use std::path::PathBuf;
use std::process::Command;

/// The unit with its binary replaced by one that exists here; `None`, with a clear line, where systemd is missing.
fn unit() -> Option<(tempfile::TempDir, PathBuf)> {
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        eprintln!("skipped: no systemd-analyze (package `systemd`)");
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/nightfix.service")).unwrap();
    assert!(text.contains("ExecStart=/usr/bin/nightfix run --config /etc/nightfix/nightfix.toml\n"));
    let file = folder.path().join("nightfix.service");
    std::fs::write(&file, text.replace("/usr/bin/nightfix", env!("CARGO_BIN_EXE_nightfix"))).unwrap();
    Some((folder, file))
}

#[test]
fn systemd_accepts_the_unit_without_a_word() {
    let Some((_folder, file)) = unit() else { return };
    let verified = Command::new("systemd-analyze").args(["verify", "--man=no"]).arg(&file).output().unwrap();
    let said = String::from_utf8_lossy(&verified.stderr);
    assert!(verified.status.success(), "{said}");
    // An unknown key or section is only a warning to systemd.
    assert!(!said.contains("nightfix.service"), "{said}");
}

#[test]
fn the_unit_is_hardened() {
    let Some((_folder, file)) = unit() else { return };
    let judged = Command::new("systemd-analyze")
        .args(["security", "--offline=true", "--threshold=20", "--no-pager"])
        .arg(&file)
        .output()
        .unwrap();
    assert!(judged.status.success(), "{}", String::from_utf8_lossy(&judged.stdout));
    let text = std::fs::read_to_string(&file).unwrap();
    for line in ["Type=notify", "WatchdogSec=10", "Restart=on-failure", "DynamicUser=yes", "StateDirectory=nightfix"] {
        assert!(text.lines().any(|l| l == line), "{line}");
    }
}
