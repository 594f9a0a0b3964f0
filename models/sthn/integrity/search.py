"""Search beyond D_C: how often is the vehicle found, after how many frames, in how wide a region?

    python -m sthn.integrity.search --nightfix target/release/nightfix --bundle models/bundles/lite-1536 \
        --maps ../shared/data/maps --out models/reports/integrity/search.md

A trial is a flight of its own, replayed by the built program from a cold start, gates and guard on: five frames along a line at
20 m/s, 42 to 60 m apart, each with the same prior, a disc of so many km2 that holds the whole flight and lies, with half a
frame beside it, wholly on the map. *Found*: the place that the first frame gave and every gate accepted, published or not.
*Published*: what the program stated as a fix within so many frames; by its rule never the first frame alone. Right is within
50 m of the truth. The same frames over another map (`another place`) tell how often a place is found where none is.

The large discs need a map of 12 km: procedural worlds at 2 m/px (the networks look at 2.7 and 5.3 m/px; a world's side is 8 000
px at most). All areas are tried with the same flights. The real maps `dubai_t1` and `dubai_t3`, which training never saw, are
small: they hold discs of 1 and 1.5 km2, and `whole map`, a disc that covers all of it. `tried` is the ground on which the
frame's middle was really tried, by the program's own evidence. Time is that of a frame on one core, the first of a trial with
all map features of the region encoded anew; the budget is `search.budget_ms` of `config/nightfix.toml`, which a replay, having
no clock, does not keep.

With the defaults the command takes about 11 minutes of one core (2 x 25 s for the worlds; a trial 3.5 s, of which the start 2 s,
and 0.12 s a km2), twice the `--trials` about twice that. The time of a frame is that of the wall: nothing else should run.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from tqdm import tqdm

from .report import upper_bound
from .trials import call, rewrite, whole_command

CONFIG = Path(__file__).parents[3] / "config/nightfix.toml"
AREAS_KM2 = (1, 2, 4, 8, 16, 32, 64, 100)
REAL_AREAS_KM2 = (1, 1.5)
REAL_MAPS = ("demo/dubai_t1.tif", "demo/dubai_t3.tif")
FRAMES_PER_TRIAL = 5
AFTER = (1, 2, 3, 5)
RIGHT_M = 50.0

SPEED_MPS, STEP_M = 20.0, 42.0
"""Between frames at least this: other ground by `track.confirm_distance_m` and `track.confirm_after_s`; at most sqrt(2) times it,
so that the guard's reach stays under `track.max_agreement_share` of the smallest disc's radius."""

FOOTPRINT_DIAGONAL_M = 1045.0
"""Of the simulator's camera at its default height, and 2 % more: what it keeps from the border of its area is half of it."""

HALF_FRAME_M = 256.0
"""The disc stays so far inside the map: the frame's square lies on it wherever in the disc its middle is."""

MAX_DRAWS = 400
"""Flights drawn per trial until the largest disc about one lies on the map."""

NEGATIVE_AREAS_KM2 = (16, 64)
GEOD = pyproj.Geod(ellps="WGS84")


@dataclass(frozen=True)
class Ground:
    """A map to search."""

    name: str
    path: Path
    whole: bool = False
    """Whether its last disc covers all of the map."""


@dataclass
class Frame:
    """A line of `fixes.jsonl`."""

    found_m: float | None
    """Error of the place found, where the gates accepted one."""
    published_m: float | None
    """Error of the fix, where one was published."""
    reason: str
    searched_km2: float
    total_ms: float


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


def budget_ms(config: Path | None = None) -> float:
    """Milliseconds that the service gives a search, by a configuration or by default."""
    stated = tomllib.loads(config.read_text()).get("search", {}) if config else {}
    return float(stated.get("budget_ms", tomllib.loads(CONFIG.read_text())["search"]["budget_ms"]))


def centre_for(
    bounds: tuple[float, float, float, float], truth: np.ndarray, radius_m: float, rng: np.random.Generator
) -> tuple[float, float] | None:
    """The middle of a disc on the map (left, bottom, right, top) that holds all of `truth` [frames, 2]: uniform over those that
    do; none where there is none. Metres in the map's axes."""
    left, bottom, right, top = bounds
    inset, reach_m = radius_m + HALF_FRAME_M, radius_m - 1.0
    low = np.maximum([left + inset, bottom + inset], truth.max(0) - reach_m)
    high = np.minimum([right - inset, top - inset], truth.min(0) + reach_m)
    if (low > high).any():
        return None
    for _ in range(1000):
        at = rng.uniform(low, high)
        if np.hypot(*(truth - at).T).max() <= reach_m:
            return float(at[0]), float(at[1])
    return None


def make_world(seed: int, args: argparse.Namespace) -> Path:
    """A procedural world; made once."""
    folder = args.work / f"world-{seed}-{args.world_size_m:g}-{args.world_m_per_px:g}"
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        world = ["--world", str(seed), "--world-size-m", f"{args.world_size_m:g}", "--world-m-per-px", f"{args.world_m_per_px:g}"]
        call([str(args.nightfix), "simulate", *world, "--out", str(folder), "--frames", "1", "--area-m", "1300"])
        (folder / "done").touch()
    return folder / "world.tif"


def simulate(ground: Ground, seed: int, args: argparse.Namespace) -> Path:
    """A trial's flight: a short line somewhere on the map; made once."""
    # A world's folder says its size too.
    over = ground.path.stem if ground.whole else ground.path.parent.name
    folder = args.work / f"{over}-{seed}"
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        noise = ["--yaw-noise-deg", "5", "--scale-noise", "0.05", "--attitude-noise-deg", "2", "--report-attitude"]
        area_m = FOOTPRINT_DIAGONAL_M + STEP_M * (FRAMES_PER_TRIAL - 1)
        words = ["--trajectory", "line", "--speed-mps", f"{SPEED_MPS:g}", "--area-m", f"{area_m:g}", "--seed", str(seed)]
        words += ["--frames", str(FRAMES_PER_TRIAL), *noise]
        call([str(args.nightfix), "simulate", "--map", str(ground.path), "--out", str(folder), *words])
        (folder / "done").touch()
    return folder


def truth_of(flight: Path) -> list[tuple[float, float]]:
    """Latitude and longitude of every frame."""
    with (flight / "poses.csv").open() as file:
        return [(float(row["truth_lat_deg"]), float(row["truth_lon_deg"])) for row in csv.DictReader(file)]


def in_map(ground: Ground, flight: Path) -> tuple[tuple, np.ndarray, pyproj.Transformer]:
    """The map's bounds and the flight's places in its axes."""
    with rasterio.open(ground.path) as source:
        bounds, crs = source.bounds, source.crs
    to_map = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
    return tuple(bounds), np.array([to_map.transform(lon, lat) for lat, lon in truth_of(flight)]), to_map


def flights_over(ground: Ground, count: int, largest_m: float, first_seed: int, args: argparse.Namespace) -> list[Path]:
    """As many flights about which a disc of the largest radius lies on the map."""
    flights: list[Path] = []
    for seed in range(first_seed, first_seed + MAX_DRAWS * count):
        if len(flights) == count:
            break
        flight = simulate(ground, seed, args)
        bounds, truth, _ = in_map(ground, flight)
        if centre_for(bounds, truth, largest_m, np.random.default_rng(seed)) is None:
            shutil.rmtree(flight)
            continue
        flights.append(flight)
    if len(flights) < count:
        raise SystemExit(f"{ground.path}: expected {count} flights inside discs of {largest_m:.0f} m on it, found {len(flights)}")
    return flights


def disc_about(ground: Ground, flight: Path, area_km2: float | None, seed: int) -> tuple[tuple[float, float], float]:
    """(latitude, longitude) and radius of a trial's disc; without an area that which covers the map."""
    bounds, truth, to_map = in_map(ground, flight)
    if area_km2 is None:
        at, radius_m = whole_disc(bounds)
    else:
        radius_m = radius_of(area_km2)
        at = centre_for(bounds, truth, radius_m, np.random.default_rng([seed, int(1000 * area_km2)]))
        if at is None:
            raise SystemExit(f"{ground.path}: expected room for a disc of {area_km2:g} km2 about {flight.name}, found none")
    lon, lat = to_map.transform(*at, direction="INVERSE")
    return (lat, lon), radius_m


def whole_disc(bounds: tuple[float, float, float, float]) -> tuple[tuple[float, float], float]:
    """The disc through the corners of what the frame's middle can reach on the map."""
    left, bottom, right, top = bounds
    return ((left + right) / 2, (bottom + top) / 2), math.hypot(right - left - 400, top - bottom - 400) / 2


def replay(
    flight: Path, name: str, over: Path, centre: tuple[float, float], radius_m: float, args: argparse.Namespace
) -> list[Frame]:
    """A trial: the flight with this disc as every row's prior, by a program that starts anew."""
    folder = args.work / "trials" / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in ("flight.toml", "poses.csv"):
        shutil.copy(flight / file, folder / file)
    (folder / "frames").symlink_to((flight / "frames").resolve())
    prior = {"prior_lat_deg": f"{centre[0]:.9f}", "prior_lon_deg": f"{centre[1]:.9f}", "prior_radius_m": f"{radius_m:.2f}"}
    rewrite(folder, lambda rows: [row | prior for row in rows])
    words = ["--map", str(over), "--bundle", str(args.bundle), "--search-radius-m", f"{radius_m + 1:.1f}"]
    words += ["--config", str(args.config)] if args.config else []
    call([str(args.nightfix), "replay", str(folder), *words, "--out", str(folder / "replay")])
    lines = [json.loads(line) for line in (folder / "replay/fixes.jsonl").open()]
    return [read(line, at) for line, at in zip(lines, truth_of(folder), strict=True)]


def read(line: dict, truth: tuple[float, float]) -> Frame:
    """What a frame gave: the place found (published, or held back until another frame confirms it), and the fix."""
    evidence, latency = line["evidence"], line["latency_ms"]
    published = distance_m((line["lat_deg"], line["lon_deg"]), truth) if line["status"] == "fix" else None
    found = published
    if line.get("reason") == "held_back" and "search_east_m" in evidence:
        prior = line["prior"]
        at = moved(prior["lat_deg"], prior["lon_deg"], evidence["search_east_m"], evidence["search_north_m"])
        found = distance_m(at, truth)
    searched, total_ms = evidence.get("search_km2", math.nan), latency.get("total", math.nan)
    return Frame(found, published, line.get("reason", "fix"), searched, total_ms)


def summary(trials: list[list[Frame]], budget: float, right: bool = True) -> dict:
    """Shares over trials; with `right` false every place is wrong."""
    frames = [frame for trial in trials for frame in trial]

    def good(error_m: float) -> bool:
        return right and error_m <= RIGHT_M

    reasons: dict[str, int] = {}
    for frame in frames:
        reasons[frame.reason] = reasons.get(frame.reason, 0) + 1
    first = [trial[0].found_m for trial in trials]
    found = [frame.found_m for frame in frames if frame.found_m is not None]
    fixes = [frame.published_m for frame in frames if frame.published_m is not None]
    total = np.array([frame.total_ms for frame in frames])
    result = {
        "trials": len(trials),
        "frames": len(frames),
        "searched_km2": float(np.nanmean([f.searched_km2 for f in frames])),
        "searched_least_km2": float(np.nanmin([f.searched_km2 for f in frames])),
        "first_right": sum(e is not None and good(e) for e in first) / len(trials),
        "first_wrong": sum(e is not None and not good(e) for e in first) / len(trials),
        "found": len(found),
        "found_wrong": sum(not good(e) for e in found),
        "published": len(fixes),
        "published_wrong": sum(not good(e) for e in fixes),
        "median_ms": float(np.median(total)),
        "p95_ms": float(np.percentile(total, 95)),
        "first_frame_median_ms": float(np.median([trial[0].total_ms for trial in trials])),
        "within_budget": float((total <= budget).mean()),
        "reasons": reasons,
    }
    for count in AFTER:
        so_far = [[f.published_m for f in trial[:count] if f.published_m is not None] for trial in trials]
        # A trial with a wrong fix among its first is wrong, whatever else was published.
        wrong = sum(any(not good(e) for e in errors) for errors in so_far)
        result[f"right_after_{count}"] = (sum(bool(errors) for errors in so_far) - wrong) / len(trials)
        result[f"wrong_after_{count}"] = wrong / len(trials)
    result["wrong_trials"] = wrong
    result["wrong_trials_upper95"] = upper_bound(wrong, len(trials))
    return result


def table(rows: list[tuple[str, float | None, dict]]) -> list[str]:
    """Markdown."""
    after = " | ".join(f"published after {n}" for n in AFTER)
    head = f"| map | disc, km2 | tried, km2 | trials | found by the first frame: right / wrong | {after} "
    head += "| trials with a wrong fix (95 % bound) | places found, wrong "
    head += "| ms a frame: median | P95 | first of a trial | within budget |"
    lines = [head, "|" + "---|" * (head.count("|") - 1)]
    for name, area, s in rows:
        shares = " | ".join(f"{s[f'right_after_{n}']:.0%} / {s[f'wrong_after_{n}']:.0%}" for n in AFTER)
        disc = "whole map" if area is None else f"{area:g}"
        lines.append(
            f"| {name} | {disc} | {s['searched_km2']:.2f} | {s['trials']} | {s['first_right']:.0%} / {s['first_wrong']:.0%} "
            f"| {shares} | {s['wrong_trials']} ({s['wrong_trials_upper95']:.1%}) | {s['found_wrong']} of {s['found']} "
            f"| {s['median_ms']:.0f} | {s['p95_ms']:.0f} | {s['first_frame_median_ms']:.0f} | {s['within_budget']:.0%} |"
        )
    return lines


@dataclass(frozen=True)
class Job:
    """A trial to be."""

    row: str
    area_km2: float | None
    flight: Path
    ground: Ground
    """Where it is searched for: another one than it was flown over makes it a trial of another place."""
    right: bool = True

    def run(self, seed: int, args: argparse.Namespace) -> list[Frame]:
        """Its frames."""
        size = "whole" if self.area_km2 is None else f"{self.area_km2:g}km2"
        name = f"{self.flight.name}-{size}" + ("" if self.right else "-elsewhere")
        if self.right:
            centre, radius_m = disc_about(self.ground, self.flight, self.area_km2, seed)
        else:
            with rasterio.open(self.ground.path) as source:
                bounds, to_degrees = source.bounds, pyproj.Transformer.from_crs(source.crs, 4326, always_xy=True)
            at, radius_m = whole_disc(tuple(bounds))
            radius_m = radius_m if self.area_km2 is None else radius_of(self.area_km2)
            lon, lat = to_degrees.transform(*at)
            centre = (lat, lon)
        return replay(self.flight, name, self.ground.path, centre, radius_m, args)


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """All trials: worlds, real maps, another place."""
    worlds = [Ground(f"world {seed}", make_world(seed, args)) for seed in tqdm(args.worlds, desc="worlds", file=sys.stderr)]
    real = [Ground(Path(name).stem, args.maps / name, whole=True) for name in REAL_MAPS] if args.maps else []
    jobs: list[Job] = []
    flown: list[tuple[Ground, list[Path]]] = []
    for i, ground in enumerate([*worlds, *real]):
        here = worlds if ground in worlds else real
        areas = args.areas if ground in worlds else [a for a in REAL_AREAS_KM2 if a <= max(args.areas)]
        # Trials are shared out over the maps of a kind.
        count = args.trials // len(here) + (here.index(ground) < args.trials % len(here))
        flights = flights_over(ground, count, radius_of(max(areas)), 10_000 * (i + 1), args) if count else []
        flown.append((ground, flights))
        row = "worlds" if ground in worlds else ground.name
        for area in [*areas, *([None] if ground.whole else [])]:
            jobs += [Job(row, area, flight, ground) for flight in flights]
    for area in [a for a in NEGATIVE_AREAS_KM2 if a <= max(args.areas)]:
        for i, (ground, flights) in enumerate(flown):
            others = [world for world in worlds if world != ground]
            if others:
                jobs += [Job("another place", area, flight, others[i % len(others)], right=False) for flight in flights]
    return jobs


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.integrity.search", description=__doc__, formatter_class=raw)
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--bundle", type=Path, default=Path("models/bundles/lite-1536"))
    parser.add_argument("--maps", type=Path, help="folder with demo/dubai_t1.tif and demo/dubai_t3.tif; absent: worlds alone")
    parser.add_argument("--out", type=Path, required=True, help="Markdown; the numbers go beside it as JSON")
    parser.add_argument("--work", type=Path, default=Path("target/integrity/search"))
    parser.add_argument("--worlds", type=int, nargs="+", default=[401, 402])
    parser.add_argument("--world-size-m", type=float, default=12000.0)
    parser.add_argument("--world-m-per-px", type=float, default=2.0)
    parser.add_argument("--config", type=Path, help="of the replays; by default the program's own")
    parser.add_argument("--trials", type=int, default=6, help="of each area over all worlds together, and over both real maps")
    parser.add_argument("--areas", type=float, nargs="+", default=list(AREAS_KM2), help="of the disc, km2")
    args = parser.parse_args(words)
    if args.trials < 1:
        parser.error(f"--trials: expected at least 1, found {args.trials}")

    budget = budget_ms(args.config)
    done: dict[tuple[str, float | None], list[tuple[Job, list[Frame]]]] = {}
    for i, job in enumerate(tqdm(jobs_of(args), desc="trials", file=sys.stderr)):
        done.setdefault((job.row, job.area_km2), []).append((job, job.run(i, args)))
    rows = []
    for (name, area), trials in done.items():
        rows.append((name, area, summary([frames for _, frames in trials], budget, trials[0][0].right)))

    about = (__doc__ or "").split("\n\n", 2)[2].rsplit("\n\n", 1)[0].strip()
    lines = ["# Search beyond D_C", "", f"`{whole_command(parser, args)}`", "", about, "", *table(rows), ""]
    lines += [
        f"Budget: {budget:.0f} ms a frame. Worlds: {args.world_size_m / 1000:g} km a side at {args.world_m_per_px:g} m/px. The "
        "frames of a trial overlap by nine tenths: they are looks at one place, not at five.",
        "",
    ]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text("\n".join(lines))
    numbers = [{"map": name, "area_km2": area, **found} for name, area, found in rows]
    args.out.with_suffix(".json").write_text(json.dumps(numbers, indent=1) + "\n")
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
