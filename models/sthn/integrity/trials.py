"""Trials: simulated flights over maps, replayed by the built program; what it said and by how much it was wrong.

    python -m sthn.integrity.trials --plan calibration --bundle models/bundles/lite-1536 --maps ../shared/data/maps \
        --out target/integrity/calibration.csv

A plan names flights (`PLANS`): which map, which noise, which D_C, how many frames, and what is done to the frames. Every
plan is seeded; a flight that was made of the same plan, and a replay newer than what it is made of, are not made again. The
table has a row per frame: flight, map, category, error, stated radius, status, reason and every number of the evidence. Beside
it `<out>.command` keeps the command that made it, for the reports.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from PIL import Image
from tqdm import tqdm

WATER_SHARE = 0.6
"""A footprint with more water than this is not localisable."""

OPEN_WATER_SHARE = 0.99
"""A footprint with more water than this is open water: no shore in it that could be matched."""

REPORT_ERRORS = {"tilt_deg": 0.5, "map_m": 1.0, "stamp_m": 0.5}
"""Errors of a `stated` flight, 1-sigma per axis: what the default error budget states (`config/nightfix.toml`)."""

WATER_PLACES = 21
"""Priors that each frame over open water is tried with: as many at each radius of `RADII`."""

FRAME_HEIGHT, FRAME_WIDTH = 512, 640


@dataclass(frozen=True)
class Flight:
    """A flight of a plan."""

    name: str
    source: str
    """Map under `--maps`, or `world:SEED`."""
    seed: int
    frames: int
    radius_m: float = 512.0
    yaw_noise_deg: float = 5.0
    scale_noise: float = 0.05
    over: str = ""
    """Map that it is replayed over, where that is another place: then every fix is wrong."""
    category: str = "localisable"
    stated: bool = False
    """Whether attitude, map and time stamps are wrong by what the budget states; else they are exact, and the error is
    that of the match alone."""
    sigma_prior: bool = False
    """Whether the priors state a sigma of `radius_m` / 3 (the same disc) in place of the radius: then `prior_chi2` is in the
    evidence."""
    words: tuple[str, ...] = ("--attitude-noise-deg", "2", "--report-attitude")

    def simulate_words(self, maps: Path) -> list[str]:
        """Arguments of `nightfix simulate`."""
        kind, _, seed = self.source.partition(":")
        source = ["--world", seed] if kind == "world" else ["--map", str(maps / self.source)]
        noise = ["--yaw-noise-deg", str(self.yaw_noise_deg), "--scale-noise", str(self.scale_noise)]
        return [
            *source,
            "--frames",
            str(self.frames),
            "--seed",
            str(self.seed),
            "--radius-m",
            str(self.radius_m),
            *noise,
            *self.words,
        ]


T4, BERKELEY = "train/dubai_t4_west.tif", "train/naip_berkeley.tif"
T1, T3 = "demo/dubai_t1.tif", "demo/dubai_t3.tif"
RADII = (64.0, 256.0, 512.0)


def localisable(prefix: str, maps: tuple[str, ...], seed: int, frames: int, **more: bool) -> list[Flight]:
    """Flights over every map at every radius, half of them with the harder noise; `more` goes to each flight."""
    flights = []
    for i, source in enumerate(maps):
        for j, radius_m in enumerate(RADII):
            hard = (i + j) % 2 == 1
            noise = (10.0, 0.1) if hard else (5.0, 0.05)
            name = f"{prefix}-{i}-{radius_m:.0f}"
            flights.append(Flight(name, source, seed + 10 * i + j, frames, radius_m, *noise, **more))
    return flights


def negatives(prefix: str, place: str, other: str, seed: int, frames: int, sigma_prior: bool = False) -> list[Flight]:
    """What must not be placed: frames of another place, and frames that are none. Of each kind `frames`, in equal parts at
    every radius."""
    kinds = ("blank", "shutter", "noise", "hituav")
    flights = []
    for j, radius_m in enumerate(RADII):
        count = frames // len(RADII) + (j < frames % len(RADII))
        at, end = seed + (1 + len(kinds)) * j, f"{radius_m:.0f}"
        base = Flight(f"{prefix}-elsewhere-{end}", other, at, count, radius_m, sigma_prior=sigma_prior)
        flights.append(replace(base, over=place, category="another place"))
        flights += [
            replace(base, name=f"{prefix}-{kind}-{end}", source=place, seed=at + 1 + i, category=kind)
            for i, kind in enumerate(kinds)
        ]
    return flights


def turned(prefix: str, maps: tuple[str, ...], seed: int, frames: int) -> list[Flight]:
    """Frames over their own place whose yaw is wrong by 90, 180 or 270 degrees: what repeats itself on the ground looks
    alike then."""
    base = Flight("", "", 0, frames, category="turned")
    return [
        replace(base, name=f"{prefix}-turned-{i}", source=source, seed=seed + i, radius_m=RADII[i % len(RADII)])
        for i, source in enumerate(maps)
    ]


PLANS: dict[str, list[Flight]] = {
    "calibration": [
        *localisable("cal", (T4, BERKELEY, "world:201", "world:202"), 1000, 60),
        *negatives("cal", T4, BERKELEY, 1100, 60),
        *negatives("calb", BERKELEY, T4, 1120, 40),
        *turned("cal", ("world:201", T4, BERKELEY, T4, BERKELEY, "world:202"), 1200, 30),
    ],
    "test": [
        *localisable("test", (T1, T3, "world:301", "world:302"), 2000, 100, stated=True),
        # Half of what belongs nowhere states a sigma too: of the `exact` flights alone hardly any answer is wrong.
        *localisable("exact", (T1, T3, "world:301", "world:302"), 2300, 25, sigma_prior=True),
        *negatives("test", T1, BERKELEY, 2100, 150),
        *negatives("testb", T3, T4, 2120, 150, sigma_prior=True),
        *turned("test", ("world:301", T1, T3, T1, T3, "world:302"), 2400, 50),
        Flight("test-water", T3, 2200, 400, category="open water"),
    ],
}


def whole_command(parser: argparse.ArgumentParser, args: argparse.Namespace) -> str:
    """The command with every option that has a value, defaults too: what a report says it was made by."""
    words = ["python", "-m", parser.prog]
    for action in parser._actions:
        value = getattr(args, action.dest, None)
        if not action.option_strings or value is None or value is False:
            continue
        words.append(action.option_strings[-1])
        if value is not True:
            words += [f"{v:g}" if isinstance(v, float) else str(v) for v in (value if isinstance(value, list) else [value])]
    return shlex.join(words)


def call(words: list[str], allowed: tuple[int, ...] = (0,)) -> None:
    """A program that must end well."""
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode not in allowed:
        raise SystemExit(f"{' '.join(words)}: exit {done.returncode}\n{done.stderr}")


def spoil(frames: list[Path], kind: str, seed: int, thermal: Path) -> None:
    """Replaces frames by what a camera gives when it sees nothing of the ground, or of another ground."""
    rng = np.random.default_rng(seed)
    others = sorted(thermal.glob("*.jpg")) if kind == "hituav" else []
    if kind == "hituav" and not others:
        raise SystemExit(f"{thermal}: expected frames (*.jpg), found none")
    for path in frames:
        shape = FRAME_HEIGHT, FRAME_WIDTH
        y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
        level = rng.uniform(3000, 12000)
        if kind == "blank":
            raw = np.full(shape, level) + rng.uniform(0, 3) * rng.standard_normal(shape)
        elif kind == "shutter":
            # The closed shutter: a smooth cushion of the optics' own warmth, columns and noise of the sensor.
            cushion = rng.uniform(-60, 60) * (x * x + y * y) + rng.uniform(-30, 30) * x + rng.uniform(-30, 30) * y
            columns = rng.uniform(1, 8) * rng.standard_normal((1, shape[1]))
            raw = level + cushion + columns + rng.uniform(1, 10) * rng.standard_normal(shape)
        elif kind == "noise":
            fine = rng.standard_normal(shape)
            cells = int(rng.integers(4, 60))
            coarse = Image.fromarray(rng.standard_normal((cells, cells)).astype(np.float32)).resize(shape[::-1], Image.BICUBIC)
            raw = level + rng.uniform(50, 400) * (fine + rng.uniform(0, 2) * np.asarray(coarse))
        else:
            picture = Image.open(others[int(rng.integers(len(others)))]).convert("L")
            turned = picture.rotate(float(rng.uniform(0, 360)), Image.BICUBIC, expand=False)
            w, h = turned.size
            side = int(min(w, h) * 0.7)
            left, top = (w - side) // 2, (h - side) // 2
            crop = turned.crop((left, top, left + side, top + side)).resize(shape[::-1], Image.BICUBIC)
            raw = 4000 + 12.0 * np.asarray(crop, dtype=np.float64)
        Image.fromarray(np.clip(np.round(raw), 0, 65535).astype(np.uint16)).save(path)


def run(flight: Flight, args: argparse.Namespace) -> list[dict]:
    """Makes and replays a flight; its rows."""
    folder = args.work / flight.name
    done = folder / "done"
    if not done.exists() or done.read_text() != repr(flight):
        if folder.exists():
            shutil.rmtree(folder)
        call([str(args.nightfix), "simulate", "--out", str(folder), *flight.simulate_words(args.maps)])
        if flight.category in ("blank", "shutter", "noise", "hituav"):
            spoil(sorted((folder / "frames").glob("*.png")), flight.category, flight.seed, args.thermal)
        if flight.category == "open water":
            keep_water(folder, flight)
        if flight.category == "turned":
            turn(folder, flight.seed)
        if flight.over:
            relocate(folder, args.maps / flight.over if ":" not in flight.over else None, flight.seed, args)
        if flight.sigma_prior:
            state_sigma(folder, flight)
        if flight.stated:
            state_errors(folder, flight.seed)
        done.write_text(repr(flight))
    kind = flight.source.partition(":")[0]
    map_path = args.maps / (flight.over or flight.source) if kind != "world" or flight.over else folder / "world.tif"
    out = folder / f"replay-{args.bundle.name}"
    # Gates off: an answer for every frame, and the reason for which the gates would have withheld it.
    made = out / "fixes.jsonl"
    inputs = (args.bundle / "bundle.toml", args.nightfix, done)
    if made.exists() and all(made.stat().st_mtime > path.stat().st_mtime for path in inputs):
        return read(flight, folder, out)
    call(
        [
            str(args.nightfix),
            "replay",
            str(folder),
            "--map",
            str(map_path),
            "--bundle",
            str(args.bundle),
            "--out",
            str(out),
            "--gates",
            "off",
        ]
    )
    return read(flight, folder, out)


def turn(folder: Path, seed: int) -> None:
    """The yaw is wrong by a quarter, a half or three quarters of a turn."""
    rng = np.random.default_rng(seed)

    def change(rows: list[dict]) -> list[dict]:
        turns = rng.integers(1, 4, len(rows))
        return [
            row | {"yaw_deg": f"{(float(row['yaw_deg']) + 90.0 * n) % 360.0:.4f}"} for row, n in zip(rows, turns, strict=True)
        ]

    rewrite(folder, change)


def relocate(folder: Path, over: Path | None, seed: int, args: argparse.Namespace) -> None:
    """Puts the priors of a flight on another map, uniform over the places where its frame would lie on it. The truth is
    kept where it is: every fix is wrong by kilometres."""
    if over is None:
        raise SystemExit("over: expected a map, found a world")
    with rasterio.open(over) as source:
        bounds, crs = source.bounds, source.crs
    to_degrees = pyproj.Transformer.from_crs(crs, 4326, always_xy=True)
    rng = np.random.default_rng(seed)
    inset = 300.0

    def change(rows: list[dict]) -> list[dict]:
        for row in rows:
            x = rng.uniform(bounds.left + inset, max(bounds.right - inset, bounds.left + inset + 1))
            y = rng.uniform(bounds.bottom + inset, max(bounds.top - inset, bounds.bottom + inset + 1))
            lon, lat = to_degrees.transform(x, y)
            row["prior_lat_deg"], row["prior_lon_deg"] = f"{lat:.8f}", f"{lon:.8f}"
        return rows

    rewrite(folder, change)


def rewrite(folder: Path, change) -> None:
    """Replaces the rows of `poses.csv` by `change(rows)`."""
    with (folder / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    rows = change(rows)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "poses.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def state_sigma(folder: Path, flight: Flight) -> None:
    """Priors that state a sigma: drawn as a Gaussian about the truth, again where the disc of 3 sigma would not hold it (1.1 %:
    such a frame is not to be found). Priors over another place stay where they are."""
    geod, rng, sigma_m = pyproj.Geod(ellps="WGS84"), np.random.default_rng([flight.seed, 8]), flight.radius_m / 3

    def change(rows: list[dict]) -> list[dict]:
        for row in rows:
            row |= {"prior_sigma_m": repr(sigma_m), "prior_radius_m": ""}
            off = rng.normal(0, sigma_m, 2)
            while np.hypot(*off) >= 3 * sigma_m:
                off = rng.normal(0, sigma_m, 2)
            if flight.over:
                continue
            at = float(row["truth_lon_deg"]), float(row["truth_lat_deg"])
            lon, lat, _ = geod.fwd(*at, math.degrees(math.atan2(off[0], off[1])), float(np.hypot(*off)))
            row |= {"prior_lat_deg": f"{lat:.9f}", "prior_lon_deg": f"{lon:.9f}"}
        return rows

    rewrite(folder, change)


def state_errors(folder: Path, seed: int) -> None:
    """Makes reported attitude and true position wrong by what the budget states: an attitude error as it is, map and time
    stamp errors as a shift of the truth."""
    geod, rng = pyproj.Geod(ellps="WGS84"), np.random.default_rng([seed, 7])

    def change(rows: list[dict]) -> list[dict]:
        for row in rows:
            for axis in ("pitch_deg", "roll_deg"):
                row[axis] = f"{float(row[axis]) + rng.normal(0, REPORT_ERRORS['tilt_deg']):.5f}"
            shift = rng.normal(0, math.hypot(REPORT_ERRORS["map_m"], REPORT_ERRORS["stamp_m"]), 2)
            lon, lat = float(row["truth_lon_deg"]), float(row["truth_lat_deg"])
            lon, lat, _ = geod.fwd(lon, lat, math.degrees(math.atan2(shift[0], shift[1])), float(np.hypot(*shift)))
            row["truth_lat_deg"], row["truth_lon_deg"] = f"{lat:.9f}", f"{lon:.9f}"
        return rows

    rewrite(folder, change)


def keep_water(folder: Path, flight: Flight) -> None:
    """Keeps the rows over open water, each with several priors drawn from discs of every radius: as many frame-and-place
    trials."""
    geod, rng = pyproj.Geod(ellps="WGS84"), np.random.default_rng(flight.seed)
    with (folder / "truth.csv").open() as file:
        water = {row["file"] for row in csv.DictReader(file) if float(row["water_share"]) > OPEN_WATER_SHARE}

    def change(rows: list[dict]) -> list[dict]:
        over = [row for row in rows if row["file"] in water]
        if not over:
            raise SystemExit(f"{folder}: expected frames over open water, found none")
        again = []
        for i, row in ((i, row) for i in range(WATER_PLACES) for row in over):
            lon, lat = float(row["truth_lon_deg"]), float(row["truth_lat_deg"])
            radius_m = RADII[i % len(RADII)]
            lon, lat, _ = geod.fwd(lon, lat, rng.uniform(0, 360), radius_m * math.sqrt(rng.random()))
            stamp = int(row["stamp_ns"]) + i * 10_000_000_000_000
            prior = {"prior_lat_deg": f"{lat:.8f}", "prior_lon_deg": f"{lon:.8f}", "prior_radius_m": str(radius_m)}
            again.append(row | prior | {"stamp_ns": str(stamp)})
        return again

    rewrite(folder, change)


def read(flight: Flight, folder: Path, out: Path) -> list[dict]:
    """Rows of a replayed flight."""
    with (folder / "truth.csv").open() as file:
        truth = {row["file"]: row for row in csv.DictReader(file)}
    rows = []
    for line in (out / "fixes.jsonl").open():
        fix = json.loads(line)
        water = float(truth[fix["file"]].get("water_share") or 0.0)
        category = flight.category
        if category == "localisable" and water > WATER_SHARE:
            category = "water"
        row = {
            "flight": flight.name,
            "file": fix["file"],
            "map": flight.over or flight.source,
            "category": category,
            "radius_m": round(fix.get("prior", {}).get("radius_m", flight.radius_m), 3),
            "water_share": water,
            "status": fix["status"],
            "reason": fix.get("reason") or fix.get("withheld", ""),
            "error_m": math.nan if fix["error_m"] is None else fix["error_m"],
            "sigma_m": math.sqrt(fix["covariance_enu_m2"][0][0]) if "covariance_enu_m2" in fix else math.nan,
            "radius95_m": fix.get("radius95_m", math.nan),
            "radius999_m": fix.get("radius999_m", math.nan),
            "p_over_25m": fix.get("p_over_25m", math.nan),
        }
        rows.append(row | {f"e.{name}": value for name, value in fix["evidence"].items()})
    return rows


def write_table(rows: list[dict], path: Path) -> None:
    """CSV; columns of all rows, absent numbers empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.integrity.trials", description=__doc__, formatter_class=raw)
    parser.add_argument("--plan", choices=sorted(PLANS), required=True)
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--maps", type=Path, required=True, help="folder with train/ and demo/")
    parser.add_argument("--thermal", type=Path, help="folder of real frames of other places; by default beside --maps")
    parser.add_argument("--out", type=Path, required=True, help="CSV")
    parser.add_argument("--work", type=Path, default=Path("target/integrity/flights"))
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--only", nargs="+", help="flights whose names start so")
    args = parser.parse_args(words)
    args.thermal = args.thermal or args.maps.parent / "thermal_frames/hituav"
    flights = [f for f in PLANS[args.plan] if not args.only or f.name.startswith(tuple(args.only))]
    rows = []
    for flight in tqdm(flights, file=sys.stderr):
        rows += run(flight, args)
    write_table(rows, args.out)
    args.out.with_suffix(".command").write_text(whole_command(parser, args) + "\n")
    print(f"{args.out}: {len(rows)} frames of {len(flights)} flights")


if __name__ == "__main__":
    main()
