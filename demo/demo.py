"""The main job from end to end, with the daemon running: `make demo`.

A procedural world and a recorded night flight over it are made; `nightfix run` is started on a loopback port; the
flight is played to it over Zenoh, frame by frame; an independent subscriber receives the fixes. What comes out, in
`target/demo/`: `metrics.json`, `track.jpg`, `overlay.jpg`, the messages and the daemon's log.

Exit status: 0 when the fixes reach the bar, 1 when they do not or something fails, 130 after Ctrl-C.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from flight import Flight, Row, read_flight
from player import Player, play
from score import error_m, failed_bars, metrics
from services import Daemon, DemoError, Subscriber, free_port

ROOT = Path(__file__).resolve().parent.parent
VEHICLE = "demo"
D_C_M = 512
OUTPUTS = ("daemon.log", "fixes.jsonl", "metrics.json", "nightfix.toml", "overlay.jpg", "rectified.png", "track.jpg")
# What must be reached for status 0.
BAR = {"min_coverage": 0.7, "max_median_m": 10.0, "max_over_50m": 0.02}


def say(text: str) -> None:
    """A line of progress."""
    print(text, flush=True)


def shown(path: Path) -> Path:
    """A path as one would type it from the project's root."""
    return path.relative_to(ROOT) if path.is_relative_to(ROOT) else path


def progress(done: int, total: int) -> None:
    """One line that counts up on a terminal, else a line now and then."""
    if sys.stdout.isatty():
        print(f"\r  frame {done}/{total}", end="\n" if done == total else "", flush=True)
    elif done % 10 == 0 or done == total:
        say(f"  frame {done}/{total}")


def run_binary(binary: Path, *arguments: object) -> None:
    """Runs a sub-command of nightfix to its end."""
    command = [str(binary), *map(str, arguments)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode != 0:
        raise DemoError(f"`{' '.join(command)}` ended with status {done.returncode}:\n{done.stderr}")


def make_flight(binary: Path, folder: Path, seed: int, frames: int) -> Flight:
    """World, map and recorded flight, all from the seed."""
    run_binary(
        binary, "simulate", "--world", seed, "--seed", seed, "--out", folder, "--frames", frames, "--trajectory", "lawnmower",
        "--radius-m", D_C_M, "--yaw-noise-deg", 5, "--scale-noise", 0.05, "--attitude-noise-deg", 1, "--report-attitude",
    )  # fmt: skip
    return read_flight(folder)


def write_config(path: Path, map_path: Path, bundle: Path, endpoint: str) -> None:
    """What differs from `config/nightfix.toml`. JSON strings are TOML strings."""
    path.write_text(
        f"[vehicle]\nname = {json.dumps(VEHICLE)}\n\n"
        f"[map]\npath = {json.dumps(str(map_path))}\n\n"
        f"[bundle]\npath = {json.dumps(str(bundle))}\n\n"
        f"[zenoh]\nmulticast = false\nlisten.endpoints = [{json.dumps(endpoint)}]\n"
    )


def fly(binary: Path, flight: Flight, bundle: Path, out: Path) -> list[dict]:
    """Starts daemon and subscriber, plays the flight, stops both; one answer per frame."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = out / "nightfix.toml"
    write_config(config, flight.map_path, bundle, endpoint)
    say(f"daemon: nightfix run --config {shown(config)}, Zenoh on {endpoint}")
    daemon = Daemon(binary, config, out / "daemon.log")
    subscriber = player = None
    try:
        player = Player(endpoint, VEHICLE)
        player.wait_for(daemon)
        subscriber = Subscriber(endpoint, VEHICLE)
        if subscriber.next(timeout_s=30.0) != {"subscribed": True}:
            raise DemoError("the subscriber heard nothing from the daemon within 30 s")
        say(f"flight: {len(flight.rows)} frames, each answered before the next is sent")
        answers = play(flight, player, subscriber, daemon, progress)
    except BaseException:
        # The first failure counts, not what ending the processes may add to it.
        for process in (daemon.process, subscriber and subscriber.process):
            if process and process.poll() is None:
                process.terminate()
                try:
                    process.wait(10.0)
                except subprocess.TimeoutExpired:
                    process.kill()
        raise
    player.close()
    subscriber.stop()
    if (status := daemon.stop()) != 0:
        raise DemoError(f"nightfix run ended with status {status} after SIGTERM, expected 0; see {out / 'daemon.log'}")
    say("daemon: stopped by SIGTERM, status 0")
    return answers


def table(rows: list[Row], answers: list[dict]) -> str:
    """Truth, fix, error and 95 % radius of each frame, or the reason for none."""
    lines = [f"{'frame':>5}  {'truth lat':>11} {'lon':>11}  {'fix lat':>11} {'lon':>11}  {'error m':>8} {'r95 m':>7}  reason"]
    for index, (row, answer) in enumerate(zip(rows, answers, strict=True)):
        truth = f"{row.truth[0]:11.6f} {row.truth[1]:11.6f}" if row.truth else f"{'-':>11} {'-':>11}"
        if answer["status"] == "fix":
            error = error_m(answer, row)
            fix = f"{answer['lat_deg']:11.6f} {answer['lon_deg']:11.6f}"
            numbers = f"{'-' if error is None else f'{error:.1f}':>8} {answer['radius95_m']:7.1f}"
            lines.append(f"{index:5}  {truth}  {fix}  {numbers}")
        else:
            lines.append(f"{index:5}  {truth}  {'-':>11} {'-':>11}  {'-':>8} {'-':>7}  {answer['reason']}")
    return "\n".join(lines)


def draw(binary: Path, flight: Flight, answers: list[dict], found: dict, out: Path) -> None:
    """The track, and one typical frame on the map."""
    import cv2  # slow to load, and needed only here

    import pictures

    pictures.track(flight, answers, found, out / "track.jpg")
    say(f"track over the map: {shown(out / 'track.jpg')}")
    if (pair := pictures.typical(flight, answers)) is None:
        say("no fix, so no overlay")
        return
    row, answer = pair
    rectified = out / "rectified.png"
    pose = [
        text
        for name, value in row.attachment(flight.hfov_deg).items()
        if name not in ("stamp_ns", "encoding", "width", "height")
        for text in (f"--{name.replace('_', '-')}={value}",)
    ]
    run_binary(binary, "frame", row.path, "--out", rectified, *pose)
    pictures.overlay(flight, row, answer, cv2.imread(str(rectified), cv2.IMREAD_GRAYSCALE), out / "overlay.jpg")
    say(f"one frame on the map:  {shown(out / 'overlay.jpg')}")


def run(arguments: argparse.Namespace) -> int:
    """The demo; its exit status."""
    out = arguments.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(out / "flight", ignore_errors=True)
    for name in OUTPUTS:
        (out / name).unlink(missing_ok=True)
    say(f"world and flight: seed {arguments.seed}, {arguments.frames} frames")
    flight = make_flight(arguments.binary, out / "flight", arguments.seed, arguments.frames)
    answers = fly(arguments.binary, flight, arguments.bundle.resolve(), out)

    with open(out / "fixes.jsonl", "w") as file:
        file.writelines(json.dumps(answer) + "\n" for answer in answers)
    found = metrics(flight.rows, answers)
    (out / "metrics.json").write_text(json.dumps(found, indent=2) + "\n")
    say("\n" + table(flight.rows, answers) + "\n")
    draw(arguments.binary, flight, answers, found, out)

    errors = found["error_m"]
    say(f"metrics:              {shown(out / 'metrics.json')}")
    say(f"{found['fixes']} fixes in {found['frames']} frames: coverage {found['coverage']:.2f}")
    say(f"no fix: {', '.join(f'{reason} {count}' for reason, count in found['no_fix'].items()) or 'none'}")
    if found["scored"]:
        say(f"error: median {errors['median']:.1f} m, 95 % {errors['p95']:.1f} m, largest {errors['max']:.1f} m")
    for failure in (failures := failed_bars(found, **BAR)):
        say(f"FAILED: {failure}")
    return 1 if failures else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=int(os.environ.get("DEMO_SEED") or 1), help="world, flight and priors")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--binary", type=Path, default=ROOT / "target/release/nightfix")
    parser.add_argument("--bundle", type=Path, default=ROOT / "models/bundles/lite-1536")
    parser.add_argument("--out", type=Path, default=ROOT / "target/demo")
    arguments = parser.parse_args()

    def interrupt(_signal, _frame):
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    try:
        return run(arguments)
    except DemoError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ndemo: interrupted; daemon and subscriber were stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
