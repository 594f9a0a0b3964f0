"""The bar of the light bundle: recorded flights over maps it never saw, replayed by the built program, gates off.

    python -m sthn.lite.bar --bundle models/bundles/lite-1536 --maps ../shared/data/maps/demo --out target/bar

Frames by `nightfix simulate` (its renderer has no part in training), priors uniform in the disc of D_C = 512 m, yaw noise
5 degrees, scale noise 5 %, seeds 1 to 3. Every frame counts whose footprint is under 60 % water. Two-stage and one-stage,
with and without noise, each map apart and pooled. The table goes to `--table` (Markdown) and `--json`, the pooled row of the
first noise to `--put`: the `[accuracy]` table of that bundle. `--radius-m` is D_C, for the smaller bundles of a ladder.

MACE is against a square of the stated height, for the flight has no other truth: the simulator's error of height counts against
the method (5 % of it moves a corner by 18 m), whatever the net does about it. The other columns are of the position.
"""

from __future__ import annotations

import argparse
import csv
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyproj
from tqdm import tqdm

from .. import correlate, geometry
from .. import manifest as rules
from ..bundle import GRAPHS, read_bundle, write_bundle

WATER_SHARE = 0.6
NOISES = {
    "yaw 5 deg, scale 5 %": ["--yaw-noise-deg", "5", "--scale-noise", "0.05"],
    "none": [],
    "yaw 10 deg, scale 10 %": ["--yaw-noise-deg", "10", "--scale-noise", "0.1"],
}


def one_stage(bundle: Path, out: Path) -> Path:
    """The bundle without its refine stage, through the same door."""
    whole = read_bundle(bundle)
    golden = {k: v for k, v in whole.golden.items() if not k.startswith("refine")}
    found = correlate.run_coarse(whole, golden["map_rgb"], golden["frame"])
    manifest = {k: v for k, v in whole.manifest.items() if k not in ("golden", "refine")}
    spec = manifest["coarse"]["map"]
    inclusive = geometry.inclusive_of_edges(found.quad, spec["width_m"] / spec["size_px"], manifest["window_margin_m"])
    golden["final"] = geometry.displacement_of(spec["size_px"], inclusive)
    golden["homography"] = geometry.homography_of_edges(int(manifest["frame_width_m"]), found.quad)
    manifest["coarse"] = {k: v for k, v in manifest["coarse"].items() if k not in ("map_graph", "graph")}
    write_bundle(out, manifest, {name: bundle / f"{name}.onnx" for name in GRAPHS[:2]}, golden)
    return out


def run(command: list[str | Path], allowed: tuple[int, ...] = (0,)) -> None:
    """A command that must end well."""
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode not in allowed:
        sys.exit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stderr}")


def corner_error_m(fix: dict, pose: dict[str, str]) -> float | None:
    """Mean distance of the frame's corners from a 512 m square at the truth, turned by truth_yaw - yaw: `mace_m` of one
    row (contract)."""
    if fix["status"] != "fix":
        return None
    window, size = fix["window"], 512
    earth = pyproj.Geod(ellps="WGS84")
    truth = float(pose["truth_lon_deg"]), float(pose["truth_lat_deg"])
    azimuth, _, length = earth.inv(window["lon_deg"], window["lat_deg"], *truth)
    centre = np.array([length * np.sin(np.radians(azimuth)), -length * np.cos(np.radians(azimuth))])
    turn_deg = float(pose["truth_yaw_deg"]) - float(pose["yaw_deg"])
    wanted = correlate.similarity_quad(centre + (window["width_m"] - 1) / 2, turn_deg, 1.0, size)
    found = geometry.apply(fix["homography"], geometry.edge_corners(size))
    return float(np.linalg.norm(found - wanted, axis=1).mean())


def read_flight(flight: Path, fixes: Path) -> list[dict]:
    """Every row of a replay with the share of water under it and its corner error."""
    water = {row["file"]: float(row["water_share"]) for row in csv.DictReader((flight / "truth.csv").open())}
    poses = {row["file"]: row for row in csv.DictReader((flight / "poses.csv").open())}
    rows = [json.loads(line) for line in (fixes / "fixes.jsonl").open()]
    return [
        {
            "error_m": row["error_m"],
            "water_share": water[row["file"]],
            "mace_m": corner_error_m(row, poses[row["file"]]),
        }
        for row in rows
    ]


def summary(rows: list[dict]) -> dict:
    """Errors over all rows that count; a row without an answer counts as above every bound. CE is `mean_m`."""
    counted = [row for row in rows if row["water_share"] <= WATER_SHARE]
    errors = np.array([np.inf if row["error_m"] is None else row["error_m"] for row in counted])
    scored = errors[np.isfinite(errors)]
    corners = np.array([row["mace_m"] for row in counted if row["mace_m"] is not None])
    return {
        "frames": len(rows),
        "counted": len(counted),
        "coverage": len(scored) / max(1, len(errors)),
        "median_m": float(np.median(errors)),
        "mean_m": float(scored.mean()),
        "p95_m": float(np.percentile(scored, 95)),
        "p99_m": float(np.percentile(scored, 99)),
        "within_25m": float((errors <= 25).mean()),
        "over_25m": float((errors > 25).mean()),
        "over_50m": float((errors > 50).mean()),
        "mace_m": float(corners.mean()),
    }


def main() -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.lite.bar", description=__doc__, formatter_class=raw)
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--maps", type=Path, nargs="+", required=True, help="GeoTIFFs, or a folder of them")
    parser.add_argument("--out", type=Path, default=Path("target/bar"))
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--frames", type=int, default=100, help="per map and seed")
    parser.add_argument("--noise", nargs="+", default=list(NOISES), choices=list(NOISES))
    parser.add_argument("--stages", nargs="+", default=["two", "one"], choices=["two", "one"])
    parser.add_argument("--radius-m", type=float, default=512.0, help="D_C")
    parser.add_argument("--put", action="store_true", help="write [accuracy] into the bundle")
    parser.add_argument("--table", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    maps = [p for m in args.maps for p in (sorted(m.glob("*.tif")) if m.is_dir() else [m]) if not p.stem.endswith("_classes")]
    bundles = {"two": args.bundle}
    if "one" in args.stages:
        bundles["one"] = one_stage(args.bundle, args.out / "one-stage")
    results = []
    jobs = [(noise, m, seed) for noise in args.noise for m in maps for seed in args.seeds]
    gathered: dict = {}
    for noise, path, seed in tqdm(jobs, file=sys.stderr):
        flight = args.out / f"{path.stem}-{list(NOISES).index(noise)}-{seed}"
        if flight.exists():
            shutil.rmtree(flight)
        words = ["simulate", "--map", path, "--out", flight, "--frames", args.frames, "--seed", seed, "--radius-m", args.radius_m]
        run([args.nightfix, *words, *NOISES[noise]])
        for stage in args.stages:
            fixes = flight / f"replay-{stage}"
            run([args.nightfix, "replay", flight, "--map", path, "--bundle", bundles[stage], "--gates", "off", "--out", fixes])
            gathered.setdefault((stage, noise, path.stem), []).extend(read_flight(flight, fixes))
    for stage in args.stages:
        for noise in args.noise:
            pooled = [row for path in maps for row in gathered[stage, noise, path.stem]]
            for name, rows in [(path.stem, gathered[stage, noise, path.stem]) for path in maps] + [("pooled", pooled)]:
                results.append({"stages": stage, "noise": noise, "map": name, **summary(rows)})
    text = table(results)
    print(text)
    if args.table:
        args.table.write_text(report(sys.argv[1:], args.radius_m, text))
    if args.put:
        row = next(r for r in results if (r["stages"], r["noise"], r["map"]) == ("two", args.noise[0], "pooled"))
        put_accuracy(args.bundle, row, args.radius_m, [p.stem for p in maps])
    if args.json:
        args.json.write_text(json.dumps(results, indent=2) + "\n")


def report(words: list[str], radius_m: float, text: str) -> str:
    """The page of a run: its command, what its numbers are, the table."""
    said = __doc__.split("\n\n", 2)[2].replace("D_C = 512 m", f"D_C = {radius_m:g} m")
    return f"# The bar\n\n`python -m sthn.lite.bar {shlex.join(words)}`\n\n{said}\n{text}\n"


def put_accuracy(bundle: Path, row: dict, radius_m: float, maps: list[str]) -> None:
    """Replaces `[accuracy]` in `bundle.toml`, through the manifest's own rules."""
    accuracy = {
        "data": f"{', '.join(maps)}; {row['noise']}; priors uniform in the disc; gates off; under 60 % water",
        "command": f"python -m sthn.lite.bar --bundle {bundle} --maps MAPS --radius-m {radius_m:g} --put",
        "frames": row["counted"],
        "search_radius_m": radius_m,
        **{key: round(row[key], 4) for key in ("coverage", "median_m", "mean_m", "p95_m", "over_25m", "over_50m")},
    }
    rules.put(bundle, accuracy=accuracy)


def table(results: list[dict]) -> str:
    """Markdown."""
    heads = [
        "stages",
        "noise",
        "map",
        "frames",
        "counted",
        "coverage",
        "median m",
        "mean m",
        "P95 m",
        "P99 m",
        "<= 25 m",
        "> 50 m",
    ]
    heads.append("MACE m")
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for r in results:
        cells = [r["stages"], r["noise"], r["map"], r["frames"], r["counted"], f"{r['coverage']:.3f}"]
        cells += [f"{r[k]:.2f}" for k in ("median_m", "mean_m", "p95_m", "p99_m")]
        cells += [f"{100 * r['within_25m']:.1f} %", f"{100 * r['over_50m']:.1f} %", f"{r['mace_m']:.2f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
