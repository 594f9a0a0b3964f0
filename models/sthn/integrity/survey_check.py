"""Does a survey foretell? Its coverage by cell against that of a flight on another night.

    python -m sthn.integrity.survey_check --survey target/survey --map ../shared/data/maps/demo/dubai_t3.tif \
        --bundle models/bundles/lite-1536 --nightfix target/release/nightfix --seed 77 \
        --table models/reports/survey/dubai_t3.csv

Flies a random flight over the map (`--seed` must not be the survey's), replays it, and puts every frame into its cell. Prints
JSON: mean absolute difference over cells with frames of both, their correlation, and the coverage measured over cells by what
was foretold. What is flown over a cell is few frames: with n of them a coverage has a standard error of up to 0.5 / sqrt(n),
which is printed beside. `--table` keeps every cell: its place, what was foretold, what was measured, over how many frames.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from pathlib import Path

import numpy as np
import pyproj
import rasterio

from .trials import call, whole_command

CLASSES = ((0.0, 0.25), (0.25, 0.75), (0.75, 1.01))
"""Foretold coverage, from and below."""


def fly(args: argparse.Namespace) -> list[dict]:
    """The flight's fixes and its truth."""
    options = json.loads((args.survey / "journal.jsonl").open().readline())["options"]
    if options["seed"] == args.seed:
        raise SystemExit(f"--seed: expected another than the survey's, found {args.seed}")
    folder = args.work / f"flight-{args.seed}-{args.frames}"
    camera = {"agl-m": "agl_m", "width": "width", "height": "height", "hfov-deg": "hfov_deg"}
    noise = {"radius-m": "radius_m", "yaw-noise-deg": "yaw_noise_deg", "scale-noise": "scale_noise"}
    words = [word for name, key in (camera | noise).items() for word in (f"--{name}", str(options[key]))]
    words += ["--frames", str(args.frames), "--seed", str(args.seed), "--report-attitude"]
    if not (folder / "poses.csv").exists():
        call([str(args.nightfix), "simulate", "--map", str(args.map), "--out", str(folder), *words])
    out = folder / "replay"
    call([str(args.nightfix), "replay", str(folder), "--map", str(args.map), "--bundle", str(args.bundle), "--out", str(out)])
    lines = [json.loads(line) for line in (out / "fixes.jsonl").open()]
    places = np.genfromtxt(folder / "poses.csv", delimiter=",", names=True, usecols=("truth_lat_deg", "truth_lon_deg"))
    return [
        line | {"at": (float(lon), float(lat))}
        for line, lat, lon in zip(lines, places["truth_lat_deg"], places["truth_lon_deg"], strict=True)
    ]


def cells_of(survey: Path, lines: list[dict]) -> list[dict]:
    """Surveyed cells that were flown over, north to south, west to east: foretold and measured coverage, frames."""
    with rasterio.open(survey / "survey.tif") as file:
        foretold, of_cell = file.read(1), file.transform
        to_map = pyproj.Transformer.from_crs(4326, file.crs, always_xy=True)
    to_cell = ~of_cell
    cells: dict[tuple[int, int], list[bool]] = {}
    for line in lines:
        column, row = (math.floor(v) for v in to_cell @ to_map.transform(*line["at"]))
        cells.setdefault((row, column), []).append(line["status"] == "fix")
    rows = []
    for (row, column), found in sorted(cells.items()):
        inside = 0 <= row < foretold.shape[0] and 0 <= column < foretold.shape[1]
        if not inside or not np.isfinite(foretold[row, column]):
            continue
        lon, lat = to_map.transform(*(of_cell @ (column + 0.5, row + 0.5)), direction="INVERSE")
        coverage = {"foretold": float(foretold[row, column]), "measured": float(np.mean(found)), "frames": len(found)}
        rows.append({"row": row, "column": column, "lat_deg": lat, "lon_deg": lon} | coverage)
    if not rows:
        raise SystemExit("expected frames over surveyed cells, found none")
    return rows


def write_cells(cells: list[dict], path: Path) -> None:
    """CSV, a row per cell."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(cells[0])
        for cell in cells:
            writer.writerow(f"{value:.6f}" if isinstance(value, float) else value for value in cell.values())


def compare(cells: list[dict]) -> dict:
    """Foretold against measured, over all cells."""
    said, seen, count = (np.array([cell[name] for cell in cells]) for name in ("foretold", "measured", "frames"))
    classes = {}
    for low, high in CLASSES:
        here = (said >= low) & (said < high)
        frames = int(count[here].sum())
        classes[f"{low:g} to {min(high, 1.0):g}"] = {
            "cells": int(here.sum()),
            "frames": frames,
            "foretold": float((said[here] * count[here]).sum() / frames) if frames else None,
            "measured": float((seen[here] * count[here]).sum() / frames) if frames else None,
        }
    constant = len(set(said)) == 1 or len(set(seen)) == 1
    return {
        "cells": len(cells),
        "frames": int(count.sum()),
        "foretold": float((said * count).sum() / count.sum()),
        "measured": float((seen * count).sum() / count.sum()),
        "mean_abs_difference": float((np.abs(said - seen) * count).sum() / count.sum()),
        "standard_error_of_a_cell": float((0.5 / np.sqrt(count) * count).sum() / count.sum()),
        "correlation": None if constant else float(np.corrcoef(said, seen)[0, 1]),
        "by_foretold": classes,
    }


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.integrity.survey_check", description=__doc__, formatter_class=raw)
    parser.add_argument("--survey", type=Path, required=True, help="folder of `nightfix survey`")
    parser.add_argument("--map", type=Path, required=True, help="the map surveyed")
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--work", type=Path, default=Path("target/integrity/survey"))
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--table", type=Path, help="CSV: a row per cell")
    args = parser.parse_args(words)
    cells = cells_of(args.survey, fly(args))
    if args.table:
        write_cells(cells, args.table)
    print(json.dumps({"command": whole_command(parser, args)} | compare(cells), indent=2))


if __name__ == "__main__":
    main()
