"""Search beyond D_C: how often is the vehicle found, after how many frames, in how wide a region?

    python -m sthn.integrity.search --nightfix target/release/nightfix --bundle models/bundles/lite-1536 \
        --maps ../shared/data/maps --out models/reports/integrity/search.md

Flights along a line over procedural worlds and a real map, frames about 100 m apart. For every area the frames get priors
whose disc has that area and holds the truth; five frames in a row are a trial, with one error of the prior. A frame's
candidate counts where every gate of the program accepts it. It is *confirmed* by an earlier candidate of the trial from
which it can have been reached: never faster than `MAX_SPEED_MPS`, over other ground. Right is within 50 m of the truth.
The same frames over another map (`another place`) tell how often a place is found where none is.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from tqdm import tqdm

from .report import upper_bound
from .trials import call, rewrite

AREAS_KM2 = (1, 4, 16, 36, 64)
FRAMES_PER_TRIAL = 5
AFTER = (2, 3, 5)
RIGHT_M = 50.0
MAX_SPEED_MPS, SLACK_M = 25.0, 100.0
"""A candidate may lie this far from where an earlier one was, grown by the time between: two errors of 50 m."""
MIN_APART_M, MIN_APART_S = 40.0, 2.0
"""Two frames show other ground where they are this far apart, or this long."""
NEGATIVE_AREA_KM2 = 16
GEOD = pyproj.Geod(ellps="WGS84")


@dataclass(frozen=True)
class Candidate:
    """What a searched frame gave, where the gates accepted it."""

    stamp_s: float
    lat_deg: float
    lon_deg: float
    error_m: float


@dataclass
class Frame:
    """A line of `fixes.jsonl`."""

    candidate: Candidate | None
    reason: str
    searched_km2: float
    total_ms: float
    correlate_ms: float


def radius_of(area_km2: float) -> float:
    """Radius of the disc of this area, metres."""
    return math.sqrt(area_km2 * 1e6 / math.pi)


def moved(lat: float, lon: float, east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude and longitude at an offset."""
    lon, lat, _ = GEOD.fwd(lon, lat, math.degrees(math.atan2(east_m, north_m)), math.hypot(east_m, north_m))
    return lat, lon


def distance_m(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Geodesic distance of two (latitude, longitude)."""
    return GEOD.inv(a[1], a[0], b[1], b[0])[2]


def confirms(first: Candidate, second: Candidate) -> bool:
    """Whether the second can have been reached from the first, and shows other ground."""
    seconds = abs(second.stamp_s - first.stamp_s)
    apart = distance_m((first.lat_deg, first.lon_deg), (second.lat_deg, second.lon_deg))
    return apart <= MAX_SPEED_MPS * seconds + SLACK_M and (apart >= MIN_APART_M or seconds >= MIN_APART_S)


def confirmed_at(frames: list[Frame]) -> tuple[int, float] | None:
    """Number of frames until a candidate is confirmed, and its error."""
    earlier: list[Candidate] = []
    for i, frame in enumerate(frames):
        if frame.candidate is None:
            continue
        if any(confirms(one, frame.candidate) for one in earlier):
            return i + 1, frame.candidate.error_m
        earlier.append(frame.candidate)
    return None


def simulate(name: str, source: list[str], args: argparse.Namespace, seed: int) -> Path:
    """A flight along a line; made once."""
    folder = args.work / name
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        noise = ["--yaw-noise-deg", "5", "--scale-noise", "0.05", "--attitude-noise-deg", "2", "--report-attitude"]
        words = ["--trajectory", "line", "--speed-mps", "20", "--frames", str(args.frames), "--seed", str(seed)]
        call([str(args.nightfix), "simulate", *source, "--out", str(folder), "--area-m", "6000", *words, *noise])
        (folder / "done").touch()
    return folder


def with_priors(flight: Path, folder: Path, radius_m: float, seed: int, centre: tuple[float, float] | None) -> None:
    """The flight with other priors: about the truth, one error per trial; or about a fixed place."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in ("flight.toml", "poses.csv"):
        shutil.copy(flight / name, folder / name)
    (folder / "frames").symlink_to((flight / "frames").resolve())
    rng = np.random.default_rng([seed, int(radius_m)])

    def change(rows: list[dict]) -> list[dict]:
        off = (0.0, 0.0)
        for i, row in enumerate(rows):
            if i % FRAMES_PER_TRIAL == 0:
                length, turn = radius_m * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
                off = (length * math.sin(turn), length * math.cos(turn))
            at = centre or moved(float(row["truth_lat_deg"]), float(row["truth_lon_deg"]), *off)
            row["prior_lat_deg"], row["prior_lon_deg"] = f"{at[0]:.8f}", f"{at[1]:.8f}"
            row["prior_radius_m"] = f"{radius_m:.2f}"
            if "prior_sigma_m" in row:
                row["prior_sigma_m"] = ""
        return rows

    rewrite(folder, change)


def replay(folder: Path, map_path: Path, radius_m: float, args: argparse.Namespace) -> list[Frame]:
    """The lines of a replay with the search switched on."""
    out = folder / "replay"
    words = ["--map", str(map_path), "--bundle", str(args.bundle), "--search-radius-m", f"{radius_m + 1:.1f}"]
    call([str(args.nightfix), "replay", str(folder), *words, "--out", str(out)])
    with (folder / "poses.csv").open() as file:
        truth = [(float(row["truth_lat_deg"]), float(row["truth_lon_deg"])) for row in csv.DictReader(file)]
    lines = [json.loads(line) for line in (out / "fixes.jsonl").open()]
    return [read(line, at) for line, at in zip(lines, truth, strict=True)]


def read(line: dict, truth: tuple[float, float]) -> Frame:
    """A frame's candidate: a fix, or one that is held back until confirmed."""
    evidence, latency = line["evidence"], line["latency_ms"]
    candidate = None
    if "search_east_m" in evidence and (line["status"] == "fix" or line.get("reason") == "held_back"):
        prior = line["prior"]
        lat, lon = moved(prior["lat_deg"], prior["lon_deg"], evidence["search_east_m"], evidence["search_north_m"])
        candidate = Candidate(line["stamp_ns"] / 1e9, lat, lon, distance_m((lat, lon), truth))
    searched = evidence.get("search_km2", math.nan)
    reason = line.get("reason", "fix")
    return Frame(candidate, reason, searched, latency.get("total", math.nan), latency.get("search_correlate", math.nan))


def trials_of(frames: list[Frame]) -> list[list[Frame]]:
    """Runs of frames that make a trial."""
    whole = len(frames) // FRAMES_PER_TRIAL
    return [frames[i * FRAMES_PER_TRIAL : (i + 1) * FRAMES_PER_TRIAL] for i in range(whole)]


def summary(trials: list[list[Frame]], right: bool = True) -> dict:
    """Shares over trials; with `right` false every candidate is wrong."""
    frames = [frame for trial in trials for frame in trial]

    def good(error_m: float) -> bool:
        return right and error_m <= RIGHT_M

    candidates = [frame.candidate for frame in frames if frame.candidate]
    reasons: dict[str, int] = {}
    for frame in frames:
        reasons[frame.reason] = reasons.get(frame.reason, 0) + 1
    first = [trial[0].candidate for trial in trials]
    confirmed = [confirmed_at(trial) for trial in trials]
    n = max(1, len(trials))
    found = {
        "trials": len(trials),
        "frames": len(frames),
        "searched_km2": float(np.nanmean([f.searched_km2 for f in frames])) if frames else math.nan,
        "first_right": sum(c is not None and good(c.error_m) for c in first) / n,
        "first_wrong": sum(c is not None and not good(c.error_m) for c in first) / n,
        "candidates": len(candidates),
        "candidates_wrong": sum(not good(c.error_m) for c in candidates),
        "total_ms": float(np.nanmedian([f.total_ms for f in frames])),
        "correlate_ms": float(np.nanmedian([f.correlate_ms for f in frames])),
        "reasons": reasons,
    }
    for count in AFTER:
        by = [c for c in confirmed if c is not None and c[0] <= count]
        found[f"right_after_{count}"] = sum(good(error) for _, error in by) / n
        found[f"wrong_after_{count}"] = sum(not good(error) for _, error in by) / n
    found["confirmed_wrong"] = sum(c is not None and not good(c[1]) for c in confirmed)
    found["confirmed_wrong_upper95"] = upper_bound(found["confirmed_wrong"], len(trials))
    return found


def table(rows: list[tuple[str, float, dict]]) -> list[str]:
    """Markdown."""
    head = "| map | disc, km2 | tried, km2 | trials | first frame: right / wrong | after 2 | after 3 | after 5 "
    head += "| confirmed and wrong (95 % bound) | candidates wrong | ms per frame (correlation) |"
    lines = [head, "|---|---|---|---|---|---|---|---|---|---|---|"]
    for name, area, s in rows:
        after = " | ".join(f"{s[f'right_after_{n}']:.0%} / {s[f'wrong_after_{n}']:.0%}" for n in AFTER)
        lines.append(
            f"| {name} | {area:g} | {s['searched_km2']:.1f} | {s['trials']} | {s['first_right']:.0%} / {s['first_wrong']:.0%} "
            f"| {after} | {s['confirmed_wrong']} ({s['confirmed_wrong_upper95']:.1%}) "
            f"| {s['candidates_wrong']} of {s['candidates']} | {s['total_ms']:.0f} ({s['correlate_ms']:.0f}) |"
        )
    return lines


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.integrity.search", description=__doc__, formatter_class=raw)
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--bundle", type=Path, default=Path("models/bundles/lite-1536"))
    parser.add_argument("--maps", type=Path, help="folder with train/dubai_t7.tif; absent: worlds alone")
    parser.add_argument("--out", type=Path, required=True, help="Markdown; the numbers go beside it as JSON")
    parser.add_argument("--work", type=Path, default=Path("target/integrity/search"))
    parser.add_argument("--worlds", type=int, nargs="*", default=[401, 402, 403, 404])
    parser.add_argument("--world-size-m", type=float, default=8000.0)
    parser.add_argument("--frames", type=int, default=50, help="of each flight: about 5 km")
    parser.add_argument("--areas", type=float, nargs="+", default=list(AREAS_KM2), help="of the disc, km2")
    args = parser.parse_args(words)

    sources = [(f"world {s}", ["--world", str(s), "--world-size-m", f"{args.world_size_m:g}"]) for s in args.worlds]
    if args.maps:
        sources.append(("dubai_t7", ["--map", str(args.maps / "train/dubai_t7.tif")]))
    flights, maps = [], []
    for i, (name, source) in enumerate(tqdm(sources, desc="flights", file=sys.stderr)):
        folder = simulate(name.replace(" ", "-"), source, args, 4000 + i)
        flights.append(folder)
        maps.append(Path(source[1]) if source[0] == "--map" else folder / "world.tif")
    rows: list[tuple[str, float, dict]] = []
    jobs = [(i, area) for area in args.areas for i in range(len(sources))]
    by_area: dict[float, list[list[Frame]]] = {}
    per_map: list[tuple[str, float, dict]] = []
    for i, area in tqdm(jobs, desc="searches", file=sys.stderr):
        folder, radius_m = args.work / f"{flights[i].name}-{area:g}km2", radius_of(area)
        with_priors(flights[i], folder, radius_m, 10 + i, None)
        trials = trials_of(replay(folder, maps[i], radius_m, args))
        by_area.setdefault(area, []).extend(trials)
        per_map.append((sources[i][0], area, summary(trials)))
    rows += [("all", area, summary(trials)) for area, trials in by_area.items()]
    negatives: list[list[Frame]] = []
    for i in tqdm(range(len(sources) if len(sources) > 1 else 0), desc="another place", file=sys.stderr):
        over = maps[(i + 1) % len(maps)]
        with rasterio.open(over) as source:
            to_degrees = pyproj.Transformer.from_crs(source.crs, 4326, always_xy=True)
            lon, lat = to_degrees.transform(*source.transform @ (source.width / 2, source.height / 2))
        folder, radius_m = args.work / f"{flights[i].name}-elsewhere", radius_of(NEGATIVE_AREA_KM2)
        with_priors(flights[i], folder, radius_m, 50 + i, (lat, lon))
        negatives += trials_of(replay(folder, over, radius_m, args))
    wrong_place = [("another place", NEGATIVE_AREA_KM2, summary(negatives, right=False))] if negatives else []

    worlds = " ".join(map(str, args.worlds))
    command = f"python -m sthn.integrity.search --bundle {args.bundle} --frames {args.frames} --worlds {worlds}"
    lines = ["# Search beyond D_C", "", f"`{command}`", "", (__doc__ or "").strip().split("\n\n", 2)[2], ""]
    lines += table(rows + wrong_place) + ["", "By map:", ""] + table(per_map)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text("\n".join(lines) + "\n")
    numbers = [{"map": name, "area_km2": area, **found} for name, area, found in rows + wrong_place + per_map]
    args.out.with_suffix(".json").write_text(json.dumps(numbers, indent=1) + "\n")
    print("\n".join(table(rows + wrong_place)))


if __name__ == "__main__":
    main()
