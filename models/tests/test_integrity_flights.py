"""Kidnapped-vehicle trials and the check of a survey: maps that are cut, what a report's last line owns up to, cells."""

import argparse
import csv
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import Affine

from sthn.integrity import kidnapped, survey_check
from sthn.lite import train


def tif(path: Path, pixels: np.ndarray, m_per_px: float = 5.0, crs: str = "EPSG:26914") -> None:
    """Pixels `[bands, rows, columns]` as a GeoTIFF."""
    bands, height, width = pixels.shape
    transform = Affine(m_per_px, 0, 485_900, 0, -m_per_px, 5_209_247)
    profile = {"driver": "GTiff", "width": width, "height": height, "count": bands, "dtype": pixels.dtype, "crs": crs}
    with rasterio.open(path, "w", transform=transform, **profile) as file:
        file.write(pixels)


def test_the_half_that_training_did_not_see_is_flown(tmp_path: Path) -> None:
    assert train.NORTH_DAKOTA_WEST == slice(0, kidnapped.EAST_FROM_COLUMN)
    other_year = [s for s in kidnapped.SCENARIOS if "north_dakota" in s.source]
    assert other_year and all(s.from_column == kidnapped.EAST_FROM_COLUMN for s in other_year)
    pixels = np.arange(4 * 6 * 10, dtype=np.uint8).reshape(4, 6, 10)
    tif(tmp_path / "map.tif", pixels)
    cut = kidnapped.cropped(tmp_path / "map.tif", 4, tmp_path / "east.tif")
    with rasterio.open(tmp_path / "map.tif") as whole, rasterio.open(cut) as east:
        assert (east.read() == pixels[:, :, 4:]).all() and east.crs == whole.crs
        assert east.colorinterp == whole.colorinterp
        assert east.bounds == (whole.bounds.left + 20.0, whole.bounds.bottom, whole.bounds.right, whole.bounds.top)
    with pytest.raises(SystemExit, match="more than 10 columns, found 10"):
        kidnapped.cropped(tmp_path / "map.tif", 10, tmp_path / "none.tif")


def test_a_flight_of_another_scenario_is_made_again() -> None:
    keys = [s.key() for s in kidnapped.SCENARIOS]
    assert len(set(keys)) == len(keys) and not any(" at 0x" in key for key in keys)


def fix(error_m: float) -> dict:
    """A line of a replay: sigma 7 m."""
    evidence = {"sigma_map_m": 1.0}
    line = {"status": "fix", "stamp_ns": int(1e9), "error_m": error_m, "radius999_m": 26.0, "evidence": evidence}
    return line | {"covariance_enu_m2": [[49.0, 0.0], [0.0, 49.0]]}


def test_the_last_line_names_the_exception() -> None:
    told = [s for s in kidnapped.SCENARIOS if s.judged][:1]
    (not_told,) = [s for s in kidnapped.SCENARIOS if not s.judged]
    lines = [fix(1.0) | {"stamp_ns": i * 10**9} for i in range(3)]
    off = [fix(30.0) | {"stamp_ns": i * 10**9} for i in range(4)]
    results = [kidnapped.judge(told[0], lines), kidnapped.judge(not_told, off)]
    args = argparse.Namespace(bundle=Path("lite-1536"), frames=60)
    text = kidnapped.table(results, args, "python -m sthn.integrity.kidnapped --bundle lite-1536")
    last = text.strip().splitlines()[-1]
    assert (
        last.startswith("In all: 0 of 3 fixes beyond") and "map shifted by 30 m, not told, where 4 of 4 fixes are beyond" in last
    )
    assert "`python -m sthn.integrity.kidnapped --bundle lite-1536`" in text


def test_a_survey_is_compared_and_kept_cell_by_cell(tmp_path: Path) -> None:
    foretold = np.array([[[1.0, 0.5], [np.nan, 0.0]]], dtype=np.float32)
    tif(tmp_path / "survey.tif", foretold, m_per_px=200.0)
    to_degrees = pyproj.Transformer.from_crs("EPSG:26914", 4326, always_xy=True)

    def line(column: int, row: int, fixed: bool) -> dict:
        at = to_degrees.transform(485_900 + 200 * (column + 0.3), 5_209_247 - 200 * (row + 0.6))
        return {"status": "fix" if fixed else "no_fix", "at": at}

    # Four in surveyed cells; one where nothing was foretold, two beside the survey.
    lines = [line(0, 0, True), line(1, 0, True), line(1, 0, False), line(1, 1, False)]
    lines += [line(0, 1, True), line(-1, 0, True), line(2, 1, True)]
    cells = survey_check.cells_of(tmp_path, lines)
    assert [(c["row"], c["column"], c["foretold"], c["measured"], c["frames"]) for c in cells] == [
        (0, 0, 1.0, 1.0, 1),
        (0, 1, 0.5, 0.5, 2),
        (1, 1, 0.0, 0.0, 1),
    ]
    found = survey_check.compare(cells)
    assert (found["cells"], found["frames"], found["mean_abs_difference"]) == (3, 4, 0.0)
    survey_check.write_cells(cells, tmp_path / "reports/cells.csv")
    with (tmp_path / "reports/cells.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 and rows[1]["measured"] == "0.500000" and rows[1]["frames"] == "2"
    x, y = pyproj.Transformer.from_crs(4326, 26914, always_xy=True).transform(
        float(rows[1]["lon_deg"]), float(rows[1]["lat_deg"])
    )
    assert (x, y) == pytest.approx((485_900 + 300, 5_209_247 - 100), abs=0.2)
    with pytest.raises(SystemExit, match="surveyed cells"):
        survey_check.cells_of(tmp_path, [line(5, 5, True)])
