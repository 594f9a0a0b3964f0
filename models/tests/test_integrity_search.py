"""The trials of the search: where discs lie, what is found, what is published, and that the program can confirm at all."""

import json
import math
import tomllib

import numpy as np
import pytest

from sthn.integrity import search
from sthn.integrity.search import Frame

HOME = (25.2, 55.3)
BOUNDS = (0.0, 0.0, 12_000.0, 12_000.0)


def frame(found_m: float | None, published_m: float | None = None, total_ms: float = 900.0) -> Frame:
    """A frame that gave a place, or none; published, or not."""
    reason = "fix" if published_m is not None else "held_back" if found_m is not None else "low_evidence"
    return Frame(found_m, published_m, reason, 3.9, total_ms)


HELD, SHOWN, NONE, WRONG = frame(1.0), frame(1.0, 1.0), frame(None), frame(3000.0, 3000.0)


def test_what_the_program_published_is_counted_and_not_what_it_found():
    trials = [[HELD, SHOWN, SHOWN, SHOWN, SHOWN], [HELD, NONE, NONE, SHOWN, SHOWN]]
    s = search.summary(trials, budget=1500.0)
    assert (s["first_right"], s["first_wrong"]) == (1.0, 0.0)
    assert [s[f"right_after_{n}"] for n in search.AFTER] == [0.0, 0.5, 0.5, 1.0]
    assert (s["found"], s["published"], s["published_wrong"], s["wrong_trials"]) == (8, 6, 0, 0)


def test_a_trial_with_a_wrong_fix_is_wrong_whatever_else_it_has():
    s = search.summary([[HELD, SHOWN, WRONG, SHOWN, SHOWN], [NONE] * 5], budget=1500.0)
    assert (s["right_after_2"], s["wrong_after_2"], s["right_after_5"], s["wrong_after_5"]) == (0.5, 0.0, 0.0, 0.5)
    assert s["wrong_trials"] == 1 and 0.7 < s["wrong_trials_upper95"] < 1.0
    elsewhere = search.summary([[HELD, SHOWN, NONE, NONE, NONE]], budget=1500.0, right=False)
    assert (elsewhere["first_right"], elsewhere["first_wrong"], elsewhere["wrong_after_2"]) == (0.0, 1.0, 1.0)


def test_time_is_of_every_frame_and_against_the_configured_budget(tmp_path):
    slow = frame(1.0, total_ms=9000.0)
    s = search.summary([[slow, HELD, SHOWN, SHOWN, SHOWN]], budget=1500.0)
    assert (s["median_ms"], s["first_frame_median_ms"], s["within_budget"]) == (900.0, 9000.0, 0.8)
    assert s["p95_ms"] == pytest.approx(7380.0)
    default = tomllib.loads(search.CONFIG.read_text())["search"]["budget_ms"]
    own = tmp_path / "own.toml"
    own.write_text("[search]\nbudget_ms = 400\n")
    (tmp_path / "other.toml").write_text("[track]\n")
    assert [search.budget_ms(), search.budget_ms(own), search.budget_ms(tmp_path / "other.toml")] == [default, 400, default]
    (head, line, row) = search.table([("worlds", None, s)])
    assert head.count("|") == line.count("|") == row.count("|") and "whole map" in row


def test_what_is_held_back_is_a_place_found_and_what_a_gate_refused_is_not():
    evidence = {"search_east_m": 300.0, "search_north_m": -40.0, "search_km2": 3.5}
    line = {
        "status": "no_fix",
        "reason": "held_back",
        "evidence": evidence,
        "latency_ms": {"total": 900.0},
        "prior": {"lat_deg": HOME[0], "lon_deg": HOME[1]},
    }
    truth = search.moved(*HOME, 300.0, -40.0)
    held = search.read(line, truth)
    assert held.found_m < 1e-3 and held.published_m is None and held.searched_km2 == 3.5
    assert search.read(line | {"reason": "ambiguous"}, HOME).found_m is None
    fix = {key: value for key, value in line.items() if key != "reason"}
    shown = search.read(fix | {"status": "fix", "lat_deg": truth[0], "lon_deg": truth[1]}, HOME)
    assert shown.published_m == pytest.approx(math.hypot(300, 40), rel=1e-3) and shown.found_m == shown.published_m


@pytest.mark.parametrize("area_km2", search.AREAS_KM2)
def test_a_disc_holds_the_flight_and_lies_on_the_map(area_km2):
    radius_m = search.radius_of(area_km2)
    assert math.pi * radius_m**2 == pytest.approx(area_km2 * 1e6)
    truth = np.array([[4000.0 + 42 * i, 3500.0] for i in range(5)])
    at = search.centre_for(BOUNDS, truth, radius_m, np.random.default_rng(1))
    assert np.hypot(*(truth - at).T).max() <= radius_m
    assert all(radius_m + search.HALF_FRAME_M <= v <= 12_000 - radius_m - search.HALF_FRAME_M for v in at)
    assert at == search.centre_for(BOUNDS, truth, radius_m, np.random.default_rng(1))


def test_a_flight_that_no_disc_on_the_map_can_hold_is_refused():
    corner = np.array([[700.0, 700.0], [868.0, 700.0]])
    assert search.centre_for(BOUNDS, corner, search.radius_of(100), np.random.default_rng(1)) is None
    assert search.centre_for((0, 0, 2391, 1931), corner, search.radius_of(4), np.random.default_rng(1)) is None


def test_real_maps_hold_their_discs():
    width_m, height_m = 2046, 1931  # the narrowest of both maps on each axis
    radius_m = search.radius_of(max(search.REAL_AREAS_KM2))
    assert 2 * (radius_m + search.HALF_FRAME_M) <= min(width_m, height_m)


def test_the_guard_can_confirm_at_this_spacing_over_the_smallest_disc():
    track = tomllib.loads(search.CONFIG.read_text())["track"]
    sigma_m = 7.5  # of a searched fix, every term of the default budget
    for step_m in (search.STEP_M, math.sqrt(2) * search.STEP_M):
        seconds = step_m / search.SPEED_MPS
        reach_m = track["max_speed_mps"] * seconds + 6 * sigma_m + track["jump_slack_m"]
        assert reach_m <= track["max_agreement_share"] * search.radius_of(min(search.AREAS_KM2))
        assert step_m >= track["confirm_distance_m"] and seconds >= track["confirm_after_s"]


def test_the_command_runs_whole_with_a_stand_in_for_the_program(tmp_path, monkeypatch):
    """Worlds, maps, priors and replays as the program leaves them; the numbers are made up."""
    rasterio = pytest.importorskip("rasterio")
    calls = []

    def tif(path, side_m):
        transform = rasterio.Affine(side_m / 8, 0, 344_000, 0, -side_m / 8, 2_790_000)
        profile = {"driver": "GTiff", "width": 8, "height": 8, "count": 1, "dtype": "uint8", "crs": "EPSG:32640"}
        with rasterio.open(path, "w", transform=transform, **profile) as file:
            file.write(np.zeros((1, 8, 8), np.uint8))

    def call(words, allowed=(0,)):
        calls.append(words)
        out = search.Path(words[words.index("--out") + 1])
        out.mkdir(parents=True, exist_ok=True)
        if "--world" in words:
            tif(out / "world.tif", 12_000.0)
        elif words[1] == "simulate":
            path = words[words.index("--map") + 1]
            side = 12_000.0 if "world" in path else 2000.0
            to = search.pyproj.Transformer.from_crs(32640, 4326, always_xy=True)
            rng = np.random.default_rng(int(words[words.index("--seed") + 1]))
            x, y = 344_000 + side * rng.uniform(0.3, 0.65), 2_790_000 - side * rng.uniform(0.35, 0.65)
            (out / "frames").mkdir()
            (out / "flight.toml").touch()
            rows = [to.transform(x + 42 * i, y) for i in range(5)]
            head = "file,stamp_ns,prior_lat_deg,prior_lon_deg,prior_radius_m,truth_lat_deg,truth_lon_deg\n"
            (out / "poses.csv").write_text(head + "".join(f"f{i}.png,{i},0,0,512,{b},{a}\n" for i, (a, b) in enumerate(rows)))
        else:
            lines = []
            for i, row in enumerate(search.csv.DictReader((out.parent / "poses.csv").open())):
                line = {"status": "fix" if i else "no_fix", "latency_ms": {"total": 700.0}}
                line |= {"evidence": {"search_km2": 3.0, "search_east_m": 0.0, "search_north_m": 0.0}}
                line |= {"lat_deg": float(row["truth_lat_deg"]), "lon_deg": float(row["truth_lon_deg"])} if i else {}
                line |= {} if i else {"reason": "held_back"}
                lines.append(line | {"prior": {"lat_deg": float(row["prior_lat_deg"]), "lon_deg": float(row["prior_lon_deg"])}})
            (out / "fixes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))

    monkeypatch.setattr(search, "call", call)
    maps = tmp_path / "maps"
    (maps / "demo").mkdir(parents=True)
    for name in search.REAL_MAPS:
        tif(maps / name, 2000.0)
    words = ["--maps", str(maps), "--out", str(tmp_path / "r.md"), "--work", str(tmp_path / "w"), "--trials", "3"]
    search.main([*words, "--areas", "1", "16"])
    numbers = {(row["map"], row["area_km2"]): row for row in json.loads((tmp_path / "r.json").read_text())}
    assert set(numbers) == {
        ("worlds", 1.0), ("worlds", 16.0), ("dubai_t1", 1), ("dubai_t1", 1.5), ("dubai_t1", None), ("dubai_t3", 1),
        ("dubai_t3", 1.5), ("dubai_t3", None), ("another place", 16),
    }  # fmt: skip
    assert (numbers["worlds", 16.0]["trials"], numbers["dubai_t1", 1]["trials"]) == (3, 2)
    assert (numbers["worlds", 1.0]["right_after_1"], numbers["worlds", 1.0]["right_after_2"]) == (0.0, 1.0)
    # The stand-in publishes the flight's own place: over another map that is wrong.
    assert numbers["another place", 16]["wrong_trials"] == numbers["another place", 16]["trials"] == 6
    text = (tmp_path / "r.md").read_text()
    for option in ("--maps", "--trials", "--areas", "--worlds", "--world-m-per-px", "--bundle"):
        assert option in text.splitlines()[2], option
    assert {len(list(search.csv.DictReader(p.open()))) for p in (tmp_path / "w/trials").glob("*/poses.csv")} == {5}
