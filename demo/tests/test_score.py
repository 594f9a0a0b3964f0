"""The demo's own metrics: made-up fixes whose errors are known by construction."""

import math
from pathlib import Path

import pytest

from flight import Row
from score import FRAME_M, WGS84, error_m, failed_bars, mean_corner_error_m, metrics

WINDOW_M = 1536.0
MIDDLE_PX = (WINDOW_M - 1) / 2
LAT_DEG, LON_DEG = 24.9, 55.2
BAR = {"min_coverage": 0.7, "max_median_m": 10.0, "max_over_50m": 0.02}


def position(east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude and longitude at an offset from the window's middle."""
    azimuth_deg = math.degrees(math.atan2(east_m, north_m))
    lon_deg, lat_deg, _ = WGS84.fwd(LON_DEG, LAT_DEG, azimuth_deg, math.hypot(east_m, north_m))
    return lat_deg, lon_deg


def row(east_m: float, north_m: float, **more: float) -> Row:
    """A row whose truth lies at an offset from the window's middle."""
    lat_deg, lon_deg = position(east_m, north_m)
    return Row(Path("frame.png"), 0, {"truth_lat_deg": lat_deg, "truth_lon_deg": lon_deg} | more)


def fix(east_m: float, north_m: float, turn_deg: float = 0.0) -> dict:
    """A fix whose frame lies at an offset, turned clockwise, at scale 1."""
    lat_deg, lon_deg = position(east_m, north_m)
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    # Pixels: x right, y down, so that a clockwise turn has this sign; the frame turns about its middle.
    half = (FRAME_M - 1) / 2
    x, y = MIDDLE_PX + east_m, MIDDLE_PX - north_m
    homography = [[cos, -sin, x - cos * half + sin * half], [sin, cos, y - sin * half - cos * half], [0, 0, 1]]
    window = {"lat_deg": LAT_DEG, "lon_deg": LON_DEG, "width_m": WINDOW_M}
    return {
        "status": "fix",
        "lat_deg": lat_deg,
        "lon_deg": lon_deg,
        "homography": homography,
        "window": window,
        "latency_ms": {"total": 10.0},
    }


def no_fix(reason: str) -> dict:
    return {"status": "no_fix", "reason": reason, "latency_ms": {"total": 2.0}}


def test_a_perfect_fix_has_no_error():
    truth = row(120.0, -300.0, yaw_deg=40.0, truth_yaw_deg=47.0)
    message = fix(120.0, -300.0, turn_deg=7.0)
    assert error_m(message, truth) == pytest.approx(0.0, abs=1e-6)
    assert mean_corner_error_m(message, truth) == pytest.approx(0.0, abs=1e-3)


def test_an_offset_is_the_error_of_centre_and_corners():
    truth, message = row(0.0, 0.0, yaw_deg=0.0, truth_yaw_deg=0.0), fix(3.0, 4.0)
    assert error_m(message, truth) == pytest.approx(5.0, abs=1e-4)
    assert mean_corner_error_m(message, truth) == pytest.approx(5.0, abs=1e-3)


def test_a_turn_the_wrong_way_moves_every_corner_by_its_chord():
    truth, message = row(10.0, 20.0, yaw_deg=0.0, truth_yaw_deg=6.0), fix(10.0, 20.0, turn_deg=-6.0)
    chord_m = 2 * (FRAME_M / math.sqrt(2)) * math.sin(math.radians(6.0))
    assert error_m(message, truth) == pytest.approx(0.0, abs=1e-6)
    assert mean_corner_error_m(message, truth) == pytest.approx(chord_m, abs=1e-2)


def test_metrics_count_fixes_reasons_and_shares():
    truth = row(0.0, 0.0, yaw_deg=0.0, truth_yaw_deg=0.0)
    messages = [fix(3.0, 4.0), fix(30.0, 0.0), fix(0.0, 60.0), no_fix("off_map"), no_fix("off_map")]
    found = metrics([truth] * 5, messages)
    assert (found["frames"], found["fixes"], found["scored"], found["coverage"]) == (5, 3, 3, 0.6)
    assert found["no_fix"] == {"off_map": 2}
    assert found["error_m"]["median"] == pytest.approx(30.0, abs=1e-3)
    assert found["error_m"]["p95"] == pytest.approx(57.0, abs=1e-2)
    assert (found["over_25m"], found["over_50m"]) == (pytest.approx(2 / 3), pytest.approx(1 / 3))
    assert found["latency_ms"]["total"]["median"] == 10.0


def test_without_a_fix_numbers_are_null_and_every_bar_is_missed():
    found = metrics([row(0.0, 0.0)], [no_fix("no_prior")])
    assert found["error_m"] == {"median": None, "mean": None, "p95": None, "p99": None, "max": None}
    assert (found["over_25m"], found["over_50m"], found["mace_m"]) == (None, None, None)
    assert len(failed_bars(found, **BAR)) == 3


def test_the_bar_is_passed_by_good_fixes_and_failed_by_few():
    truth = row(0.0, 0.0)
    assert failed_bars(metrics([truth] * 2, [fix(3.0, 4.0)] * 2), **BAR) == []
    half = failed_bars(metrics([truth] * 2, [fix(3.0, 4.0), no_fix("ambiguous")]), **BAR)
    assert half == ["coverage 0.500 is under 0.7"]
