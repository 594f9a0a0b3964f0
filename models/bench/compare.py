"""Speed of each step of a fix: nightfix beside OpenCV (one thread) and PyTorch eager, in the same run, as ratios.

    .venv/bin/python models/bench/compare.py            # what `make bench` runs

Rounds alternate between the contenders, so that a busy machine hits all alike; per step the least and the median over
all frames of all rounds are taken. nightfix is the release binary, replaying a simulated flight: its own `latency_ms`.
Every row of the flight stands there twice, the second time with its prior moved by a few metres: only the second is
counted, so that every window is made anew from a map that is warm in the cache.

The bar: decode + rectify + window + crop + DLT in at most 1.5 times OpenCV's time.
"""

import argparse
import csv
import json
import os
import statistics
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import cv2
import steps_opencv
import steps_torch
import torch

ROOT = Path(__file__).resolve().parents[2]
BAR_STEPS = ("decode", "rectify", "window", "crop", "dlt")
BAR = 1.5
# Moves the second prior of a row: another window, over the same map.
PRIOR_STEP_DEG = 3e-5

Samples = dict[str, list[float]]


def call(*command: str | Path) -> str:
    """Runs a program; its output, or its error as ours."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stderr}")
    return done.stdout


def prepare_flight(nightfix: Path, folder: Path, frames: int) -> None:
    """Simulates a flight over a procedural world and doubles its rows."""
    call(nightfix, "simulate", "--world", "1", "--seed", "1", "--frames", str(frames), "--out", folder)
    with (folder / "poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    stamps = [int(row["stamp_ns"]) for row in rows]
    again = []
    for row in rows:
        moved = str(float(row["prior_lat_deg"]) + PRIOR_STEP_DEG)
        later = str(int(row["stamp_ns"]) + max(stamps) - min(stamps) + 1_000_000_000)
        again.append(row | {"prior_lat_deg": moved, "stamp_ns": later})
    with (folder / "poses.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows + again)


def replay(nightfix: Path, flight: Path, bundle: Path, threads: int, out: Path) -> list[dict]:
    """The second half of `fixes.jsonl`."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "threads.toml").write_text(f"[onnxruntime]\nthreads = {threads}\n")
    options = ["--bundle", bundle, "--out", out, "--gates", "off", "--config", out / "threads.toml"]
    call(nightfix, "replay", flight, *options)
    lines = [json.loads(line) for line in (out / "fixes.jsonl").read_text().splitlines()]
    return lines[len(lines) // 2 :]


def poses(flight: Path) -> dict[str, dict]:
    """Pose by file."""
    with (flight / "poses.csv").open(newline="") as file:
        return {row["file"]: {"gsd_m": float(row["gsd_m"]), "yaw_deg": float(row["yaw_deg"])} for row in csv.DictReader(file)}


def add(samples: Samples, taken_ms: dict[str, float]) -> None:
    """One frame's times, and their sum over the steps of the bar."""
    for step, ms in taken_ms.items():
        samples[step].append(ms)
    samples["bar"].append(sum(taken_ms.get(step, 0.0) for step in BAR_STEPS))


def summary(samples: Samples) -> dict[str, dict[str, float]]:
    """Least and median by step."""
    return {step: {"min": min(ms), "median": statistics.median(ms)} for step, ms in samples.items()}


def table(title: str, ours: dict, theirs: dict, steps: list[str]) -> list[str]:
    """Lines of a table of the steps that both have."""
    lines = [
        "",
        title,
        f"  {'step':<12}{'nightfix min':>14}{'median':>10}{'other min':>14}{'median':>10}{'ratio min':>12}{'median':>9}",
    ]
    for step in steps:
        if step not in ours:
            continue
        line = f"  {step:<12}{ours[step]['min']:>14.3f}{ours[step]['median']:>10.3f}"
        if step in theirs:
            other = theirs[step]
            line += f"{other['min']:>14.3f}{other['median']:>10.3f}"
            line += f"{ours[step]['min'] / other['min']:>12.2f}{ours[step]['median'] / other['median']:>9.2f}"
        lines.append(line)
    return lines


def add_networks(samples: Samples) -> None:
    """The sum of the graphs' steps, so that both sides count the same."""
    steps = ("coarse_map", "coarse", "correlate", "refine_map", "refine")
    present = [samples[step] for step in steps if step in samples]
    samples["networks"] = [sum(values) for values in zip(*present, strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nightfix", type=Path, default=ROOT / "target/release/nightfix")
    parser.add_argument("--bundle", type=Path, default=ROOT / "models/bundles/lite-1536")
    parser.add_argument("--published", type=Path, help="bundle of the published architecture (default: made with random weights)")
    parser.add_argument("--no-published", action="store_true", help="the light bundle only")
    parser.add_argument("--out", type=Path, default=ROOT / "target/bench")
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--require-bar", action="store_true", help="exit 1 where the bar is missed")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    flight = options.out / "flight"
    prepare_flight(options.nightfix, flight, options.frames)
    bundles = {"light": options.bundle}
    if not options.no_published:
        published = options.published or options.out / "published"
        if not (published / "bundle.toml").is_file():
            command = ["--random-weights", "0", "--out", published, "--name", "random-1536"]
            call(sys.executable, "-m", "sthn.export", *command)
        bundles["published"] = published
    results = measure(options, flight, bundles)
    report(options, results)


def measure(options: argparse.Namespace, flight: Path, bundles: dict[str, Path]) -> dict[tuple[str, int, str], Samples]:
    """All rounds: samples by bundle, threads and contender."""
    manifests = {name: steps_opencv.manifest_of(bundle) for name, bundle in bundles.items()}
    networks = {
        name: (steps_torch.Light if manifest["coarse"]["kind"] == "correlation" else steps_torch.Published)(manifest)
        for name, manifest in manifests.items()
    }
    maps = [path for path in flight.glob("*.tif") if not path.stem.endswith("_classes")]
    picture = steps_opencv.Map(maps[0])
    pose_of = poses(flight)
    results: dict[tuple[str, int, str], Samples] = defaultdict(lambda: defaultdict(list))
    jobs = [(name, threads) for _ in range(options.rounds) for name in bundles for threads in options.threads]
    for count, (name, threads) in enumerate(jobs):
        print(f"\r{count + 1}/{len(jobs)} {name}, {threads} threads   ", end="", file=sys.stderr, flush=True)
        torch.set_num_threads(threads)
        fixes = replay(options.nightfix, flight, bundles[name], threads, options.out / name)
        for fix in fixes:
            add(results[name, threads, "nightfix"], fix["latency_ms"])
            if "homography" not in fix:
                continue
            data = (flight / fix["file"]).read_bytes()
            taken_ms, window_rgb, crop = steps_opencv.run(data, pose_of[fix["file"]], fix, picture, manifests[name])
            add(results[name, threads, "opencv"], taken_ms)
            add(results[name, threads, "torch"], networks[name].run(window_rgb, crop))
    print(file=sys.stderr)
    for samples in results.values():
        if "coarse" in samples:
            add_networks(samples)
    return results


def report(options: argparse.Namespace, results: dict[tuple[str, int, str], Samples]) -> None:
    """Prints the tables and writes `bench.json`."""
    summaries = {key: summary(samples) for key, samples in results.items()}
    lines = [f"milliseconds; {os.cpu_count()} cores, load {', '.join(f'{load:.1f}' for load in os.getloadavg())}"]
    missed = False
    for name, threads in dict.fromkeys((name, threads) for name, threads, _ in summaries):
        ours, opencv, eager = (summaries[name, threads, who] for who in ("nightfix", "opencv", "torch"))
        lines += table(
            f"{name}, {threads} thread(s): beside OpenCV on 1 thread", ours, opencv, ["decode", "tone", *BAR_STEPS[1:], "bar"]
        )
        graphs = ["coarse_map", "coarse", "correlate", "refine_map", "refine", "networks", "total"]
        lines += table(f"{name}, {threads} thread(s): ONNX Runtime beside PyTorch eager", ours, eager, graphs)
        ratio = ours["bar"]["median"] / opencv["bar"]["median"]
        missed |= ratio > BAR
        lines.append(f"  bar: {ratio:.2f} of OpenCV's time by medians, at most {BAR}: {'missed' if ratio > BAR else 'met'}")
    print("\n".join(lines))
    written = {"cores": os.cpu_count(), "load": os.getloadavg()}
    written |= {f"{name}/{threads}/{who}": values for (name, threads, who), values in summaries.items()}
    (options.out / "bench.json").write_text(json.dumps(written, indent=1) + "\n")
    if missed and options.require_bar:
        sys.exit(1)


if __name__ == "__main__":
    main()
