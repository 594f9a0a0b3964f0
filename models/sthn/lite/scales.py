"""Low flights: by how much frame, window and D_C of a bundle may be scaled down together.

    python -m sthn.lite.scales --bundle models/bundles/lite-1536 --maps ../shared/data/maps/demo --out target/scales

For each scale s a flight at s times the height, with priors within s times D_C, over a procedural world drawn at s m/px and,
where `--maps` are given, over real maps at their own 1 m/px. Replayed gates off by the built program with a bundle that
states the whole range. A scale is supported where the bar holds scaled: median at most 4 s m, 92 % within 25 s m.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

from .. import manifest as manifest_rules
from .bar import read_flight, run

SCALES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.2)
MEDIAN_M, SHARE_WITHIN_25M = 4.0, 0.92
HEIGHT_M, RADIUS_M, WORLD_M = 580.0, 512.0, 3600.0


def with_range(bundle: Path, out: Path, least: float) -> Path:
    """The bundle, stating that it supports every scale."""
    if out.exists():
        shutil.rmtree(out)
    shutil.copytree(bundle, out, ignore=shutil.ignore_patterns("training"))
    manifest_rules.put(out, scale_range=[least, 1.0])
    return out


def measure(args: argparse.Namespace, bundle: Path, source: list[str], name: str, scale: float) -> dict:
    """One flight at one scale."""
    flight = args.out / f"{name}-{scale}"
    if flight.exists():
        shutil.rmtree(flight)
    words = ["simulate", *source, "--out", flight, "--frames", args.frames, "--seed", args.seed]
    words += ["--agl-m", HEIGHT_M * scale, "--radius-m", RADIUS_M * scale, "--yaw-noise-deg", 5, "--scale-noise", 0.05]
    run([args.nightfix, *words, "--report-attitude"])
    path = flight / "world.tif" if source[0] == "--world" else source[1]
    fixes = flight / "replay"
    run([args.nightfix, "replay", flight, "--map", path, "--bundle", bundle, "--gates", "off", "--out", fixes])
    rows = [row for row in read_flight(flight, fixes) if row["water_share"] <= 0.6]
    errors = np.array([np.inf if row["error_m"] is None else row["error_m"] for row in rows]) / scale
    return {
        "over": name,
        "scale": scale,
        "frames": len(rows),
        "median_m": float(np.median(errors)) * scale,
        "median_scaled_m": float(np.median(errors)),
        "within_25_scaled": float((errors <= 25).mean()),
    }


def supported(rows: list[dict]) -> float:
    """The least scale down to which every flight holds the scaled bar."""
    least = 1.0
    for scale in sorted({row["scale"] for row in rows}, reverse=True):
        here = [row for row in rows if row["scale"] == scale]
        if any(row["median_scaled_m"] > MEDIAN_M or row["within_25_scaled"] < SHARE_WITHIN_25M for row in here):
            break
        least = scale
    return least


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.lite.scales", description=__doc__, formatter_class=raw)
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--maps", type=Path, nargs="*", default=[], help="GeoTIFFs, or a folder of them")
    parser.add_argument("--out", type=Path, default=Path("target/scales"))
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--table", type=Path, help="Markdown")
    args = parser.parse_args(words)
    args.out.mkdir(parents=True, exist_ok=True)
    maps = [p for m in args.maps for p in (sorted(m.glob("*.tif")) if m.is_dir() else [m]) if not p.stem.endswith("_classes")]
    bundle = with_range(args.bundle, args.out / "bundle", min(SCALES) * 0.9)
    rows = []
    for scale in tqdm(SCALES, file=sys.stderr):
        world = ["--world", "401", "--world-size-m", str(WORLD_M * scale), "--world-m-per-px", str(scale)]
        rows.append(measure(args, bundle, world, "world", scale))
        rows += [measure(args, bundle, ["--map", str(path)], path.stem, scale) for path in maps]
    heads = "| over | scale | frames | median m | median / scale | within 25 m x scale |"
    lines = [heads, "|---|---|---|---|---|---|"]
    for row in rows:
        cells = f"{row['median_m']:.2f} | {row['median_scaled_m']:.2f} | {100 * row['within_25_scaled']:.1f} %"
        lines.append(f"| {row['over']} | {row['scale']} | {row['frames']} | {cells} |")
    text = "\n".join(lines)
    print(text)
    drawn = supported([row for row in rows if row["over"] == "world"])
    print(json.dumps({"scale_range": [drawn, 1.0]}))
    if args.table:
        command = shlex.join(words if words is not None else sys.argv[1:])
        args.table.parent.mkdir(parents=True, exist_ok=True)
        args.table.write_text(
            f"# Low flights\n\n`python -m sthn.lite.scales {command}`\n\n{__doc__.split(chr(10) * 2, 2)[2]}\n{text}\n"
        )


if __name__ == "__main__":
    main()
