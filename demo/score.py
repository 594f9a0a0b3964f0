"""Errors of fixes against the truth, computed apart from nightfix: pyproj's geodesics on the received messages."""

import math

import numpy as np
from pyproj import Geod

from flight import Row

WGS84 = Geod(ellps="WGS84")
FRAME_M = 512.0


def error_m(message: dict, row: Row) -> float | None:
    """Geodesic distance from the fix to the truth, metres; None without either."""
    if message["status"] != "fix" or row.truth is None:
        return None
    lat_deg, lon_deg = row.truth
    return WGS84.inv(lon_deg, lat_deg, message["lon_deg"], message["lat_deg"])[2]


def mean_corner_error_m(message: dict, row: Row) -> float | None:
    """Mean distance of the fitted quad's corners to those of a 512 m square at the truth, turned by true yaw - yaw."""
    if message["status"] != "fix" or row.truth is None or "truth_yaw_deg" not in row.values:
        return None
    window = message["window"]
    half = FRAME_M / 2
    # Corners of the frame's square: east, north of its middle.
    square = np.array([[-half, half], [half, half], [-half, -half], [half, -half]])

    # Integer pixels are centres: the square's edges lie half a pixel outside, and its middle at 255.5.
    pixels = np.column_stack([square[:, 0] + half - 0.5, half - square[:, 1] - 0.5, np.ones(4)])
    mapped = pixels @ np.array(message["homography"]).T
    middle = (window["width_m"] - 1) / 2
    fitted = np.column_stack([mapped[:, 0] / mapped[:, 2] - middle, middle - mapped[:, 1] / mapped[:, 2]])

    lat_deg, lon_deg = row.truth
    azimuth_deg, _, distance_m = WGS84.inv(window["lon_deg"], window["lat_deg"], lon_deg, lat_deg)
    azimuth = math.radians(azimuth_deg)
    # Yaw turns clockwise.
    turn = math.radians(row.values["truth_yaw_deg"] - row.values.get("yaw_deg", 0.0))
    rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    expected = square @ rotation.T + distance_m * np.array([math.sin(azimuth), math.cos(azimuth)])
    return float(np.linalg.norm(fitted - expected, axis=1).mean())


def summary(values: list[float]) -> dict:
    """Median, mean, 95th and 99th percentile (linear) and largest; nulls where there is nothing."""
    if not values:
        return dict.fromkeys(("median", "mean", "p95", "p99", "max"))
    array = np.array(values)
    return {
        "median": float(np.median(array)),
        "mean": float(array.mean()),
        "p95": float(np.percentile(array, 95)),
        "p99": float(np.percentile(array, 99)),
        "max": float(array.max()),
    }


def latency(values: list[float]) -> dict:
    """Median, 95th percentile (linear) and largest."""
    return {"median": float(np.median(values)), "p95": float(np.percentile(values, 95)), "max": max(values)}


def metrics(rows: list[Row], messages: list[dict]) -> dict:
    """The contract's `metrics.json` for one message per row, in order."""
    errors = [error for error in map(error_m, messages, rows) if error is not None]
    corners = [error for error in map(mean_corner_error_m, messages, rows) if error is not None]
    fixes = sum(message["status"] == "fix" for message in messages)
    reasons = [message["reason"] for message in messages if message["status"] != "fix"]
    steps = sorted({step for message in messages for step in message["latency_ms"]})
    return {
        "frames": len(rows),
        "fixes": fixes,
        "coverage": fixes / len(rows) if rows else 0.0,
        "no_fix": {reason: reasons.count(reason) for reason in sorted(set(reasons))},
        "scored": len(errors),
        "error_m": summary(errors),
        "over_25m": sum(error > 25.0 for error in errors) / len(errors) if errors else None,
        "over_50m": sum(error > 50.0 for error in errors) / len(errors) if errors else None,
        "mace_m": float(np.mean(corners)) if corners else None,
        "latency_ms": {step: latency([m["latency_ms"][step] for m in messages if step in m["latency_ms"]]) for step in steps},
    }


def failed_bars(found: dict, min_coverage: float, max_median_m: float, max_over_50m: float) -> list[str]:
    """What misses its bar, in words. A number that is missing misses it."""
    median_m, over_50m = found["error_m"]["median"], found["over_50m"]
    failed = []
    if found["coverage"] < min_coverage:
        failed.append(f"coverage {found['coverage']:.3f} is under {min_coverage}")
    if median_m is None or median_m > max_median_m:
        failed.append(f"median error {median_m} m is over {max_median_m} m")
    if over_50m is None or over_50m > max_over_50m:
        failed.append(f"share of errors over 50 m {over_50m} is over {max_over_50m}")
    return failed
