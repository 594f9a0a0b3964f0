"""The built program by kind of ground: recorded flights by `nightfix simulate`, answered by `nightfix replay`.

    python -m sthn.evaluate.terrain --bundle models/bundles/lite-1536 --maps MAP ... --dates MAP ... --report FILE.md

Kinds of ground follow from the land cover under each frame's true footprint (`<map>_classes.tif`): water over 60 %, water
20 to 60 %, desert (bare land over 80 %), dense suburb (buildings over 15 %), mixed (the rest). `--dates` are maps of one
grid on several dates, farmland: frames are rendered from the next date, the map is of the date before, and only the
columns from `--columns-from` on are used (the others were trained on).

Every flight is answered twice: gates off, for the errors, and with the default gates, for what the program publishes.
`--out` keeps `frames.json`, a row a frame; `--from frames.json` makes the report again without a run.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import shlex
import shutil
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window
from tqdm import tqdm

from ..lite.bar import NOISES, run
from .metrics import FAILURE_M, Distribution
from .tables import Table, number, share

FRAME_M = 512.0
GRID = 64
"""Samples a side of a footprint's land cover."""

BUILDING, BARE, WATER = 1, 2, 5
"""Classes of `_classes.tif`."""

KINDS = ("water over 60 %", "water 20 to 60 %", "desert", "dense suburb", "mixed", "farmland, another date")
SUBURB_SHARE, DESERT_SHARE = 0.15, 0.8


@dataclass(frozen=True)
class Frame:
    """A row of a flight, answered."""

    flight: str
    file: str
    terrain: str
    error_m: float | None
    """Gates off; None: no answer at all."""
    reason: str
    """Why the default gates hold it back; empty: accepted."""


def kind_of(shares: dict[int, float]) -> str:
    """The kind of ground from the share of each class under a frame."""
    if shares.get(WATER, 0) > 0.6:
        return KINDS[0]
    if shares.get(WATER, 0) >= 0.2:
        return KINDS[1]
    if shares.get(BARE, 0) > DESERT_SHARE:
        return KINDS[2]
    if shares.get(BUILDING, 0) > SUBURB_SHARE:
        return KINDS[3]
    return KINDS[4]


class LandCover:
    """`_classes.tif` under a footprint."""

    def __init__(self, path: Path) -> None:
        with rasterio.open(path) as source:
            self.classes: NDArray[np.uint8] = source.read(1)
            self.inverse = ~source.transform
            self.to_map = pyproj.Transformer.from_crs("EPSG:4326", source.crs, always_xy=True)
            self.step_m = abs(source.transform.a)

    def shares(self, lat_deg: float, lon_deg: float, yaw_deg: float) -> dict[int, float]:
        """Of each class in the square of 512 m about a place, image up to `yaw_deg`; outside the map is class 0."""
        easting, northing = self.to_map.transform(lon_deg, lat_deg)
        a, b, c, d, e, f = self.inverse[:6]
        x, y = a * easting + b * northing + c, d * easting + e * northing + f
        step = FRAME_M / GRID / self.step_m
        turn = np.radians(yaw_deg)
        along, across = np.cos(turn) * step, np.sin(turn) * step
        middle = (GRID - 1) / 2
        # Grid cell -> map px; rasterio's px are edges.
        left, top = x - 0.5 - (along - across) * middle, y - 0.5 - (across + along) * middle
        matrix = np.array([[along, -across, left], [across, along, top]])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        cut = cv2.warpAffine(self.classes, matrix, (GRID, GRID), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        values, counts = np.unique(cut, return_counts=True)
        return {int(v): float(n) / cut.size for v, n in zip(values, counts, strict=True)}


def columns_of(path: Path, first: int, out: Path) -> Path:
    """RGB of a map's columns from `first` on, as a GeoTIFF of its own."""
    with rasterio.open(path) as source:
        if not 0 <= first < source.width:
            raise ValueError(f"{path}: columns: expected a first one below {source.width}, found {first}")
        window = Window(first, 0, source.width - first, source.height)
        profile = {
            "driver": "GTiff", "count": 3, "dtype": "uint8", "crs": source.crs, "width": window.width, "height": window.height,
            "transform": source.window_transform(window), "compress": "deflate",
        }  # fmt: skip
        with rasterio.open(out, "w", **profile) as made:
            made.write(source.read([1, 2, 3], window=window))
    return out


def fly(
    program: Path, bundle: Path, seen: Path, known: Path, out: Path, words: list[str], terrain: str | None, classes: Path | None
) -> list[Frame]:
    """A flight over `seen`, answered on the map `known`, gates off and on."""
    if out.exists():
        shutil.rmtree(out)
    run([program, "simulate", "--map", seen, "--out", out, "--radius-m", "512", *words])
    for gates in ("off", "on"):
        run([program, "replay", out, "--map", known, "--bundle", bundle, "--gates", gates, "--out", out / f"replay-{gates}"])
    return answered(out, terrain, classes)


def answered(out: Path, terrain: str | None, classes: Path | None) -> list[Frame]:
    """The frames of a flight that was answered both ways."""
    answers = [[json.loads(line) for line in (out / f"replay-{g}" / "fixes.jsonl").open()] for g in ("off", "on")]
    with (out / "poses.csv").open() as file:
        poses = {row["file"]: row for row in csv.DictReader(file)}
    cover = LandCover(classes) if classes else None
    frames = []
    for free, gated in zip(*answers, strict=True):
        pose = poses[free["file"]]
        kind = terrain
        if kind is None:
            assert cover is not None
            kind = kind_of(cover.shares(*(float(pose[f"truth_{n}"]) for n in ("lat_deg", "lon_deg", "yaw_deg"))))
        reason = "" if gated["status"] == "fix" else gated["reason"]
        frames.append(Frame(out.name, free["file"], kind, free["error_m"], reason))
    return frames


def table(frames: list[Frame]) -> Table:
    """A row for each kind of ground that has frames."""
    heads = [
        "terrain",
        "frames",
        "median m",
        "mean m",
        "P95 m",
        "> 25 m",
        "> 50 m",
        "accepted",
        "accepted > 25 m",
        "held back by",
    ]
    made = Table("By terrain", heads)
    for kind in (*KINDS, "all"):
        own = [f for f in frames if kind in ("all", f.terrain)]
        if not own:
            continue
        d = Distribution.of([f.error_m for f in own])
        accepted = [f for f in own if not f.reason]
        wrong = sum(f.error_m is None or f.error_m > FAILURE_M for f in accepted)
        reasons: dict[str, int] = {}
        for frame in own:
            if frame.reason:
                reasons[frame.reason] = reasons.get(frame.reason, 0) + 1
        held = ", ".join(f"{name} {count}" for name, count in sorted(reasons.items(), key=lambda item: -item[1]))
        errors = [number(v) for v in (d.median_m, d.mean_m, d.p95_m)]
        gates = [share(len(accepted) / len(own)), f"{wrong} of {len(accepted)}"]
        made.rows.append([kind, str(len(own)), *errors, share(d.over_25m), share(d.over_50m), *gates, held])
    made.notes = [
        "Position errors with gates off, of answered frames; above 25 m and 50 m of all frames. Accepted: what the default gates "
        "let through, and how many of those are above 25 m."
    ]
    return made


def identity(bundle: Path) -> str:
    """A bundle's name and the first digits of its graphs' digests: a retrained one of the same name is another."""
    manifest = tomllib.loads((bundle / "bundle.toml").read_text(encoding="utf-8"))
    digests = [f"{stage} {manifest[stage]['graph']['sha256'][:8]}" for stage in ("coarse", "refine") if stage in manifest]
    return f"{manifest['name']} ({', '.join(digests)})"


def report(frames: list[Frame], command: str, noise: str, bundle: str) -> str:
    """The page: command, table, what the kinds are."""
    kinds = (__doc__ or "").split("\n\n")[2].replace("\n", " ")
    flights = ", ".join(f"`{name}`" for name in dict.fromkeys(f.flight for f in frames))
    body = table(frames).markdown().split("\n", 2)[2]
    made_by = "Frames by `nightfix simulate` (its renderer has no part in training)"
    return (
        f"# The shipped bundle by kind of ground\n\n`{command}`\n\nBundle: {bundle}. {made_by}, noise: {noise}; priors uniform "
        f"in the disc of D_C = 512 m. Flights: {flights}.\n\n{kinds}\n\n{body}"
    )


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m sthn.evaluate.terrain", description=__doc__, formatter_class=raw)
    parser.add_argument("--bundle", type=Path, default=Path("models/bundles/lite-1536"))
    parser.add_argument("--maps", type=Path, nargs="*", default=[], help="GeoTIFFs with _classes.tif, or folders of them")
    parser.add_argument("--dates", type=Path, nargs="*", default=[], help="maps of one grid, in the order of their dates")
    parser.add_argument("--columns-from", type=int, default=467, help="of --dates")
    parser.add_argument("--frames", type=int, default=100, help="a flight")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise", choices=list(NOISES), default=next(iter(NOISES)))
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--out", type=Path, default=Path("target/terrain"))
    parser.add_argument("--report", type=Path, help="Markdown")
    parser.add_argument("--from", type=Path, dest="stored", help="frames.json of a former run: no run")
    o = parser.parse_args(words)
    try:
        if o.stored:
            stored = json.loads(o.stored.read_text())
            frames = [Frame(**row) for row in stored["frames"]]
            command, noise, bundle = stored["command"], stored["noise"], stored["bundle"]
        else:
            command, noise = "python -m sthn.evaluate.terrain " + shlex.join(words), o.noise
            bundle = identity(o.bundle)
            frames = flights(o, command, bundle)
    except (ValueError, OSError, KeyError, TypeError) as error:
        print(f"terrain: {error}", file=sys.stderr)
        return 2
    print(table(frames).markdown())
    if o.report:
        o.report.parent.mkdir(parents=True, exist_ok=True)
        o.report.write_text(report(frames, command, noise, bundle))
    return 0


def flights(o: argparse.Namespace, command: str, bundle: str) -> list[Frame]:
    """All flights of the options; `frames.json` grows with each."""
    maps = [p for m in o.maps for p in (sorted(m.glob("*.tif")) if m.is_dir() else [m]) if not p.stem.endswith("_classes")]
    if missing := [p for m in maps if not (p := m.with_name(f"{m.stem}_classes.tif")).is_file()]:
        raise ValueError(f"{missing[0]}: expected the land cover of its map, found nothing")
    if len(o.dates) == 1 or not (maps or o.dates):
        raise ValueError(f"--maps, --dates: expected a map, or two dates at least, found {len(maps)} and {len(o.dates)}")
    o.out.mkdir(parents=True, exist_ok=True)
    words = ["--frames", str(o.frames), "--seed", str(o.seed), *NOISES[o.noise]]
    jobs = [(m, m, m.stem, None, m.with_name(f"{m.stem}_classes.tif")) for m in maps]
    halves = [columns_of(path, o.columns_from, o.out / f"{path.stem}_from_{o.columns_from}.tif") for path in o.dates]
    for i, known in enumerate(halves):
        later = halves[(i + 1) % len(halves)]
        jobs.append((later, known, f"{o.dates[(i + 1) % len(halves)].stem}-on-{o.dates[i].stem[-8:]}", KINDS[5], None))
    frames: list[Frame] = []
    for seen, known, name, terrain, classes in tqdm(jobs, file=sys.stderr):
        frames += fly(o.nightfix, o.bundle, seen, known, o.out / name, words, terrain, classes)
        rows = [dataclasses.asdict(frame) for frame in frames]
        stored = {"command": command, "noise": o.noise, "bundle": bundle, "frames": rows}
        (o.out / "frames.json").write_text(json.dumps(stored) + "\n")
    return frames


if __name__ == "__main__":
    sys.exit(main())
