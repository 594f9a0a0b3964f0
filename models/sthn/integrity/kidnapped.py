"""Kidnapped-vehicle trials: flights on which something is badly wrong, replayed by the built program, gates and guard on.

    python -m sthn.integrity.kidnapped --nightfix target/release/nightfix --bundle models/bundles/lite-1536 \
        --maps ../shared/data/maps --out models/reports/integrity/kidnapped.md

For each: no published fix beyond its own `radius999_m`, and the time to the first correct fix where one is possible (correct:
within its own `radius999_m`; the time counts from the fault, or from what makes a fix possible again). Exit 1 where a fix lies
beyond. Every flight is seeded; one that was made of the same scenario is not made again. Of the North Dakota maps the east half
is flown: training saw the west.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from PIL import Image
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from rasterio.windows import Window
from tqdm import tqdm

from .trials import OPEN_WATER_SHARE, call, rewrite, whole_command

GEOD = pyproj.Geod(ellps="WGS84")
CITY, SHORE = "demo/dubai_t1.tif", "demo/dubai_t3.tif"
OLD_YEAR, NEW_YEAR = "train/naip_north_dakota_5m_20090818.tif", "train/naip_north_dakota_5m_20200831.tif"
GAUSSIAN_TAIL999 = 3.7169

EAST_FROM_COLUMN = 467
"""Of the North Dakota maps: training has the columns before (`NORTH_DAKOTA_WEST` of `sthn.lite.train`)."""

MAP_SHIFT_M = 30.0
TOLD_MAP_SIGMA_M = 10.0
"""`budget.map_sigma_m` with which a map that is wrong by `MAP_SHIFT_M` is told: 3.7 sigma of it are 37 m, the shift and the
match."""

JUMP_M = 2000.0

PRIOR_EVERY, PRIOR_RADIUS_M = 10, 256.0
"""An external prior on every so-many-th row: aged ten seconds it is as wide as D_C."""

NOISE = ("--yaw-noise-deg", "5", "--scale-noise", "0.05")
TILT_KNOWN = ("--attitude-noise-deg", "2", "--report-attitude")
TILT_UNKNOWN = ("--attitude-noise-deg", "2.12")
"""3 degrees, root mean square, of both axes together; none reported."""

Rows = list[dict]


@dataclass(frozen=True)
class Scenario:
    """A flight and what is wrong with it."""

    name: str
    source: str
    """Map under `--maps`, or `world:SEED`."""
    seed: int
    spoil: Callable[[Path, Rows, Scenario, argparse.Namespace], Rows] = lambda folder, rows, scenario, args: rows
    """Changes rows and frames."""
    words: tuple[str, ...] = TILT_KNOWN
    every: int = PRIOR_EVERY
    radius_m: float = PRIOR_RADIUS_M
    over: str = ""
    """Map that it is replayed over, where that is another."""
    shift_m: float = 0.0
    """By which the map that it is replayed over lies too far east."""
    from_column: int = 0
    """Of its maps only the columns from here on are flown over and searched."""
    budget: str = ""
    """Lines of `[budget]` for the replay."""
    from_row: Callable[[int], int] = lambda frames: 0
    """The row from which time counts."""
    possible: bool = True
    """Whether a correct fix is possible."""
    judged: bool = True
    """Whether a fix beyond its radius fails the trials."""

    def key(self) -> str:
        """What its flight is made of."""
        made_of = (self.name, self.source, self.seed, self.words, self.every, self.radius_m, self.from_column)
        return " ".join(map(str, made_of))


def moved(row: dict, metres: float, azimuth_deg: float) -> dict:
    """The row with its prior so far from the truth."""
    lon, lat, _ = GEOD.fwd(float(row["truth_lon_deg"]), float(row["truth_lat_deg"]), azimuth_deg, metres)
    return row | {"prior_lat_deg": f"{lat:.9f}", "prior_lon_deg": f"{lon:.9f}"}


def without_prior(row: dict) -> dict:
    """The row with no prior of its own."""
    return row | {"prior_lat_deg": "", "prior_lon_deg": "", "prior_radius_m": ""}


def wrong_start(stated_m: float) -> Callable:
    """One prior at the start, 400 m wrong, that says `stated_m`; then none."""

    def spoil(folder: Path, rows: Rows, scenario: Scenario, args: argparse.Namespace) -> Rows:
        first = moved(rows[0], 400.0, 60.0) | {"prior_radius_m": str(stated_m)}
        return [first, *map(without_prior, rows[1:])]

    return spoil


def jump(folder: Path, rows: Rows, scenario: Scenario, args: argparse.Namespace) -> Rows:
    """The middle of a straight flight is cut out, the clock goes on: a leap. The next prior comes `PRIOR_EVERY` rows later."""
    half, step_ns = args.frames // 2, int(rows[1]["stamp_ns"]) - int(rows[0]["stamp_ns"])
    places = [(float(row["truth_lon_deg"]), float(row["truth_lat_deg"])) for row in rows]
    far = [i for i in range(half, len(rows)) if GEOD.inv(*places[half - 1], *places[i])[2] >= JUMP_M]
    if len(far) <= PRIOR_EVERY:
        raise SystemExit(f"{folder}: expected rows {JUMP_M:g} m away, found {len(far)}")
    kept = rows[:half] + [rows[i] for i in far[:half]]
    out = [row | {"stamp_ns": str(int(rows[0]["stamp_ns"]) + i * step_ns)} for i, row in enumerate(kept)]
    for i in range(half, half + PRIOR_EVERY):
        out[i] = without_prior(out[i])
    return [*out[: half + PRIOR_EVERY], moved(out[half + PRIOR_EVERY], 150.0, 10.0) | radius(), *out[half + PRIOR_EVERY + 1 :]]


def radius() -> dict:
    """The prior's radius."""
    return {"prior_radius_m": str(PRIOR_RADIUS_M)}


def over_water(folder: Path, rows: Rows, scenario: Scenario, args: argparse.Namespace) -> Rows:
    """60 s of a land flight show open water, with no prior; at the shore an estimator's prior, 250 m wrong."""
    sea = folder.with_name(folder.name + "-sea")
    if not sea.exists():
        words = ["--map", str(args.maps / SHORE), "--frames", "60", "--seed", str(scenario.seed + 1), *NOISE, *TILT_KNOWN]
        call([str(args.nightfix), "simulate", "--out", str(sea), *words])
    with (sea / "truth.csv").open() as file:
        water = [row["file"] for row in csv.DictReader(file) if float(row["water_share"]) > OPEN_WATER_SHARE]
    if len(water) < 3:
        raise SystemExit(f"{sea}: expected frames over open water, found {len(water)}")
    first, last = water_rows(args.frames)
    step_ns = math.ceil(60e9 / (last - first))
    for i in range(first, last):
        rows[i] = without_prior(rows[i]) | {"file": f"frames/water-{i}.png"}
        shutil.copy(sea / water[i % len(water)], folder / rows[i]["file"])
    shift = 0
    for i, row in enumerate(rows):
        if first <= i <= last:
            shift += step_ns - (int(rows[1]["stamp_ns"]) - int(rows[0]["stamp_ns"]))
        rows[i] = row | {"stamp_ns": str(int(row["stamp_ns"]) + shift)}
    rows[last] = moved(rows[last], 250.0, 200.0) | {"prior_radius_m": "512"}
    return rows


def water_rows(frames: int) -> tuple[int, int]:
    """The first over water, the first over land again."""
    return frames // 4, frames // 4 + frames // 2


def upside_down(folder: Path, rows: Rows, scenario: Scenario, args: argparse.Namespace) -> Rows:
    """Frames turned by 180 degrees, the yaw as it was."""
    for row in rows:
        path = folder / row["file"]
        Image.fromarray(np.ascontiguousarray(np.asarray(Image.open(path))[::-1, ::-1])).save(path)
    return estimator(rows)


def estimator(rows: Rows) -> Rows:
    """With each row the prior of an estimator that is off by the same 200 m: continuous, and every frame can be tried."""
    return [moved(row, 200.0, 130.0) for row in rows]


def yaw_wrong(folder: Path, rows: Rows, scenario: Scenario, args: argparse.Namespace) -> Rows:
    """90 degrees to the right of what it is."""
    return [row | {"yaw_deg": f"{(float(row['yaw_deg']) + 90.0) % 360.0:.4f}"} for row in estimator(rows)]


def frozen(folder: Path, rows: Rows, scenario: Scenario, args: argparse.Namespace) -> Rows:
    """From a third on the same picture, until a prior comes near three quarters."""
    first, last = args.frames // 3, thaw(args.frames)
    return [row | {"file": rows[first]["file"]} if first <= i < last else row for i, row in enumerate(rows)]


def thaw(frames: int) -> int:
    """The first row of a camera that lives again."""
    return frames * 3 // 4 // PRIOR_EVERY * PRIOR_EVERY


SCENARIOS = [
    Scenario("nothing wrong", CITY, 41),
    Scenario("prior 400 m wrong at the start, stated 512 m", CITY, 42, wrong_start(512.0), every=1),
    Scenario("prior 400 m wrong at the start, stated 150 m", CITY, 42, wrong_start(150.0), every=1),
    Scenario("jump of 2 km", "world:401", 43, jump, from_row=lambda n: n // 2 + PRIOR_EVERY),
    Scenario("60 s over water, then land", CITY, 44, over_water, from_row=lambda n: water_rows(n)[1]),
    Scenario("map shifted by 30 m, not told", CITY, 45, shift_m=MAP_SHIFT_M, possible=False, judged=False),
    Scenario(
        f"map shifted by 30 m, `map_sigma_m = {TOLD_MAP_SIGMA_M:g}`",
        CITY,
        45,
        shift_m=MAP_SHIFT_M,
        budget=f"map_sigma_m = {TOLD_MAP_SIGMA_M}",
    ),
    Scenario(
        "map of another year (2009 flown, 2020 on board; the half that training did not see)",
        OLD_YEAR,
        46,
        over=NEW_YEAR,
        from_column=EAST_FROM_COLUMN,
    ),
    Scenario("frame upside down", CITY, 47, upside_down, every=1, radius_m=512.0, possible=False),
    Scenario("yaw wrong by 90 degrees", CITY, 48, yaw_wrong, every=1, radius_m=512.0, possible=False),
    Scenario("frozen camera", CITY, 49, frozen, from_row=thaw),
    Scenario("attitude unknown, 3 degrees of tilt", CITY, 50, words=TILT_UNKNOWN),
]


def make(scenario: Scenario, folder: Path, args: argparse.Namespace) -> None:
    """Simulates the flight, a straight one, and spoils it."""
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    kind, _, seed = scenario.source.partition(":")
    is_world = kind == "world"
    source = (
        ["--world", seed, "--world-size-m", "5000"]
        if is_world
        else ["--map", str(source_map(scenario.source, scenario, folder, args))]
    )
    # A jump of 2 km needs a long line of which the middle is cut out.
    frames = 2 * args.frames if scenario.spoil is jump else args.frames
    words = ["--frames", str(frames), "--seed", str(scenario.seed), "--trajectory", "line", "--radius-m", str(scenario.radius_m)]
    area = ["--area-m", "5000"] if is_world else []
    every = ["--prior-every", str(scenario.every)]
    call([str(args.nightfix), "simulate", "--out", str(folder), *source, *words, *area, *every, *NOISE, *scenario.words])
    rewrite(folder, lambda rows: scenario.spoil(folder, rows, scenario, args))
    (folder / "done").write_text(scenario.key())


def source_map(name: str, scenario: Scenario, folder: Path, args: argparse.Namespace) -> Path:
    """A map under `--maps`, or the columns of it that the scenario has, cut out into its folder."""
    path = args.maps / name
    return cropped(path, scenario.from_column, folder / path.name) if scenario.from_column else path


def cropped(path: Path, from_column: int, to: Path) -> Path:
    """The map from a column on, as a file of its own; made once."""
    if not to.exists():
        with rasterio.open(path) as source:
            if from_column >= source.width:
                raise SystemExit(f"{path}: expected more than {from_column} columns, found {source.width}")
            window = Window(from_column, 0, source.width - from_column, source.height)
            profile = source.profile | {"width": window.width, "transform": source.window_transform(window)}
            pixels, meaning = source.read(window=window), source.colorinterp
        # A fourth band is infrared unless the map says that it is alpha; the writer would say so unasked.
        photometric = "RGB" if meaning[0] == ColorInterp.red else "MINISBLACK"
        alpha = "YES" if ColorInterp.alpha in meaning else "UNSPECIFIED"
        with rasterio.open(to, "w", **profile | {"photometric": photometric, "alpha": alpha}) as file:
            file.write(pixels)
    return to


def map_of(scenario: Scenario, folder: Path, args: argparse.Namespace) -> Path:
    """The map to replay over."""
    is_world = scenario.source.startswith("world:")
    path = folder / "world.tif" if is_world else source_map(scenario.over or scenario.source, scenario, folder, args)
    if not scenario.shift_m:
        return path
    shifted = folder / "shifted.tif"
    if not shifted.exists():
        shutil.copy(path, shifted)
        with rasterio.open(shifted, "r+") as file:
            file.transform = Affine.translation(scenario.shift_m, 0.0) @ file.transform
    return shifted


def run(scenario: Scenario, number: int, args: argparse.Namespace) -> dict:
    """Makes and replays a flight: its line of the table."""
    folder = args.work / f"{number:02d}-{args.frames}"
    done = folder / "done"
    if not done.exists() or done.read_text() != scenario.key():
        make(scenario, folder, args)
    configuration = folder / "replay.toml"
    configuration.write_text(f"[budget]\n{scenario.budget}\n")
    out = folder / f"replay-{args.bundle.name}"
    words = ["--map", str(map_of(scenario, folder, args)), "--bundle", str(args.bundle), "--out", str(out)]
    call([str(args.nightfix), "replay", str(folder), *words, "--config", str(configuration)])
    return judge(scenario, [json.loads(line) for line in (out / "fixes.jsonl").open()])


def judge(scenario: Scenario, lines: list[dict]) -> dict:
    """Counts, and the time to the first correct fix."""
    fixes = [line for line in lines if line["status"] == "fix"]
    beyond = [line for line in fixes if line["error_m"] > line["radius999_m"]]
    from_row = scenario.from_row(len(lines))
    right = [line for line in lines[from_row:] if line["status"] == "fix" and line["error_m"] <= line["radius999_m"]]
    first_s = (right[0]["stamp_ns"] - lines[from_row]["stamp_ns"]) / 1e9 if right else None
    reasons: dict[str, int] = {}
    for line in lines:
        if line["status"] != "fix":
            reasons[line["reason"]] = reasons.get(line["reason"], 0) + 1
    errors = [line["error_m"] for line in fixes]
    return {
        "scenario": scenario,
        "frames": len(lines),
        "fixes": len(fixes),
        "beyond": len(beyond),
        "first_s": first_s,
        "median_m": float(np.median(errors)) if errors else None,
        "max_m": max(errors, default=None),
        "radius999_m": float(np.median([line["radius999_m"] for line in fixes])) if fixes else None,
        "reasons": reasons,
        "step_s": (lines[1]["stamp_ns"] - lines[0]["stamp_ns"]) / 1e9,
        "needed_map_sigma_m": needed_map_sigma(fixes),
    }


def needed_map_sigma(fixes: list[dict]) -> float:
    """The least `map_sigma_m` at which every fix is within its radius, the other terms as they are."""
    needed = 0.0
    for fix in fixes:
        variance, map_sigma = fix["covariance_enu_m2"][0][0], fix["evidence"]["sigma_map_m"]
        tail = max(GAUSSIAN_TAIL999, fix["radius999_m"] / math.sqrt(variance))
        needed = max(needed, (fix["error_m"] / tail) ** 2 - (variance - map_sigma**2))
    return math.sqrt(needed)


def table(results: list[dict], args: argparse.Namespace, command: str) -> str:
    """The report."""

    def metres(value: float | None) -> str:
        return "" if value is None else f"{value:.1f}"

    lines = [
        "# Kidnapped-vehicle trials",
        "",
        f"`{command}`",
        "",
        f"Bundle `{args.bundle.name}`, gates and guard on. Straight simulated flights, {args.frames} frames each, an external "
        f"prior every {PRIOR_EVERY} rows ({PRIOR_RADIUS_M:g} m); upside down and yaw: one with every row, 200 m off, stated "
        "512 m, so that every frame is tried. *Beyond*: published fixes "
        "further from the truth than their own `radius999_m`. *First*: seconds from the fault, or from what makes a fix "
        "possible again, to the first fix within its `radius999_m`.",
        "",
        "| fault | frames | s a frame | fixes | beyond | first, s | median error, m | largest | radius999, m | no fix |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for result in results:
        scenario = result["scenario"]
        first = "-" if not scenario.possible else "none" if result["first_s"] is None else f"{result['first_s']:.1f}"
        reasons = ", ".join(f"{name} {count}" for name, count in sorted(result["reasons"].items()))
        counts = f"{result['frames']} | {result['step_s']:.1f} | {result['fixes']} | {result['beyond']}"
        lines.append(
            f"| {scenario.name} | {counts} | {first} | "
            f"{metres(result['median_m'])} | {metres(result['max_m'])} | {metres(result['radius999_m'])} | {reasons} |"
        )
    shifted = [r["needed_map_sigma_m"] for r in results if r["scenario"].shift_m and r["fixes"]]
    if shifted:
        lines += [
            "",
            f"A map that lies {MAP_SHIFT_M:g} m off gives fixes that are {MAP_SHIFT_M:g} m off, by no fault of the matcher: it "
            f"must be told. The least `budget.map_sigma_m` that holds every fix of this flight is {max(shifted):.1f} m.",
        ]
    beyond = sum(r["beyond"] for r in results if r["scenario"].judged)
    judged = sum(r["fixes"] for r in results if r["scenario"].judged)
    last = f"In all: {beyond} of {judged} fixes beyond their `radius999_m`."
    for result in (r for r in results if not r["scenario"].judged):
        last += (
            f" The one exception, not counted in it: {result['scenario'].name}, where {result['beyond']} of "
            f"{result['fixes']} fixes are beyond; no gate can see it."
        )
    return "\n".join([*lines, "", last, ""])


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.integrity.kidnapped", description=__doc__, formatter_class=raw)
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--maps", type=Path, required=True, help="folder with train/ and demo/")
    parser.add_argument("--out", type=Path, required=True, help="Markdown")
    parser.add_argument("--work", type=Path, default=Path("target/integrity/kidnapped"))
    parser.add_argument("--nightfix", type=Path, default=Path("target/release/nightfix"))
    parser.add_argument("--frames", type=int, default=60, help="at least 40")
    parser.add_argument("--only", nargs="+", type=int, help="numbers of trials")
    args = parser.parse_args(words)
    if args.frames < 40:
        parser.error(f"--frames: expected at least 40, found {args.frames}")
    numbered = [(i, s) for i, s in enumerate(SCENARIOS) if args.only is None or i in args.only]
    results = [run(scenario, i, args) for i, scenario in tqdm(numbered, file=sys.stderr)]
    text = table(results, args, whole_command(parser, args))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text)
    print(text)
    if any(r["beyond"] for r in results if r["scenario"].judged):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
