"""Evaluation: metrics in metres by the published formulas, the paper's traps, tables and what they may quote."""

import csv
import dataclasses
import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from sthn import geometry
from sthn.data import Noise, Pair
from sthn.evaluate import metrics, quoted, run, tables
from sthn.evaluate.metrics import Distribution, Score, Summary
from sthn.evaluate.pairs import narrowed
from sthn.evaluate.results import Cell, Condition, Method, PairRecord, PairScore, PairsDigest, Results, ResultsError


def pair(displacement: np.ndarray | float, window: int = 1536, m_per_px: float = 1.0, name: str = "p") -> Pair:
    """A pair whose truth is a published displacement `[2, 2, 2]` of the 256 px input; a number: the whole frame there."""
    if np.isscalar(displacement):
        inclusive = geometry.inclusive_of_edges(geometry.edge_corners(512) + displacement, window / 256)
        displacement = geometry.displacement_of(256, inclusive)
    homography = geometry.homography_of_displacement(512, 256, displacement, window / 256)
    pixels = np.random.default_rng(len(name)).integers(0, 255, (512, 512), np.uint8)
    return Pair(name, np.zeros((window, window, 3), np.uint8), pixels, homography, m_per_px=m_per_px)


def published(predicted: np.ndarray, truth: np.ndarray, alpha: float) -> tuple[float, float]:
    """MACE and CE of one pair as the public code has them: corners 0 .. W - 1, centre at W / 2 - 0.5, times alpha."""
    corners = np.array([[0, 0], [255, 0], [0, 255], [255, 255]], np.float64)
    moved = [corners + d.reshape(2, 4).T for d in (predicted, truth)]
    mace = np.linalg.norm(moved[0] - moved[1], axis=1).mean() * alpha
    middles = []
    for target in moved:
        matrix = cv2.getPerspectiveTransform(corners.astype(np.float32), target.astype(np.float32))
        x, y, w = matrix @ [127.5, 127.5, 1.0]
        middles.append(np.array([x, y]) / w)
    return float(mace), float(np.linalg.norm(middles[0] - middles[1]) * alpha)


@pytest.mark.parametrize("window", [512, 1024, 1536])
def test_errors_are_the_published_ones_in_metres(window: int) -> None:
    alpha = window / 256
    rng = np.random.default_rng(window)
    truth, shift = pair(window / 8, window), rng.uniform(-9, 9, (2, 1, 1))
    for bend, tolerance in ((0.0, 1e-6), (2.0, 1e-6)):
        displacement = truth.displacement()
        predicted = displacement + shift + rng.uniform(-bend, bend, (2, 2, 2))
        answer = geometry.homography_of_displacement(512, 256, predicted, alpha)
        mace, ce = published(predicted, displacement, alpha)
        corner_m, centre_m = metrics.errors_m(truth, answer)
        assert corner_m == pytest.approx(mace, abs=tolerance)
        # A bent quad's edges are not quite its inclusive corners' edges: under 1 % of the centre error's own size.
        assert centre_m == pytest.approx(ce, abs=1e-4 if not bend else 0.05 * bend * alpha)


def test_a_pixel_of_the_input_is_alpha_metres_not_one() -> None:
    """Until 2025-10 the authors' numbers were in 256 px units; 4.167 of those are the 25 m of a failure."""
    truth = pair(300.0)
    off = truth.displacement() + np.array([25 / 6 * 1.01, 0.0])[:, None, None]
    corner_m, centre_m = metrics.errors_m(truth, geometry.homography_of_displacement(512, 256, off, 6.0))
    assert (corner_m, centre_m) == pytest.approx((25 * 1.01, 25 * 1.01))
    lost, kept = (Summary.of([Score(e, e)]) for e in (corner_m, corner_m / 1.02))
    assert (lost.corner.over_25m, kept.corner.over_25m) == (1.0, 0.0)


def test_the_middle_is_half_a_pixel_before_half_the_width() -> None:
    """A pure change of scale about the frame's middle has no centre error; about W / 2 it would have."""
    truth = pair(500.0)
    grown = np.array([[1.2, 0, -0.2 * 255.5], [0, 1.2, -0.2 * 255.5], [0, 0, 1.0]])
    corner_m, centre_m = metrics.errors_m(truth, truth.homography @ grown)
    assert centre_m < 1e-9
    assert corner_m == pytest.approx(0.2 * np.hypot(256, 256), abs=1e-9)
    shifted = np.array([[1.2, 0, -0.2 * 256], [0, 1.2, -0.2 * 256], [0, 0, 1.0]])
    assert metrics.errors_m(truth, truth.homography @ shifted)[1] == pytest.approx(0.2 * np.hypot(0.5, 0.5))


def test_a_low_flight_has_its_own_metres() -> None:
    low, high = pair(300.0, m_per_px=0.25), pair(300.0)
    move = np.array([[1, 0, 40.0], [0, 1, 30.0], [0, 0, 1]])
    assert metrics.errors_m(high, move @ high.homography) == pytest.approx((50, 50))
    assert metrics.errors_m(low, move @ low.homography) == pytest.approx((12.5, 12.5))


def test_no_answer_is_a_failure_apart_and_above_every_bound() -> None:
    truth = pair(300.0)
    horizon = truth.homography.copy()
    horizon[2] = [1 / 511.5, 0, 0.5 / 511.5]  # zero at the frame's left edge
    failed = [
        metrics.score(truth, None, "9 matches"),
        metrics.score(truth, np.full((3, 3), np.nan)),
        metrics.score(truth, horizon),
    ]
    assert all(s.corner_m is None and s.reason for s in failed), failed
    assert failed[0].reason == "9 matches"
    summary = Summary.of([*failed, Score(3.0, 1.0), Score(30.0, 30.0)])
    assert (summary.pairs, summary.failures, summary.failure_rate) == (5, 3, 0.6)
    assert (summary.mace_m, summary.ce_m) == (16.5, 15.5)
    assert (summary.centre.over_25m, summary.centre.over_50m) == (0.8, 0.6)
    nothing = Summary.of(failed)
    assert (nothing.mace_m, nothing.centre.p99_m, nothing.corner.over_25m) == (None, None, 1.0)


def test_percentiles_are_linear_and_bounds_strict() -> None:
    found = Distribution.of([float(v) for v in range(101)])
    assert (found.median_m, found.p95_m, found.p99_m) == (50, 95, 99)
    assert Distribution.of([25.0, 25.0001]).over_25m == 0.5


def test_a_narrower_window_is_the_same_pair() -> None:
    rng = np.random.default_rng(0)
    wide = dataclasses.replace(pair(300.0), satellite=rng.integers(0, 255, (1536, 1536, 3), np.uint8))
    slim = narrowed(wide, 1024)
    assert np.array_equal(slim.satellite, wide.satellite[256:1280, 256:1280])
    assert np.allclose(slim.quad(), wide.quad() - 256)
    digests = []
    for one in (wide, slim, pair(301.0)):
        digest = PairsDigest()
        digest.add(one)
        digests.append(digest.hex())
    assert digests[0] == digests[1] != digests[2]
    with pytest.raises(ValueError, match="at most 1536"):
        narrowed(wide, 1792)


def test_the_latency_is_the_tables_not_the_sentences() -> None:
    assert quoted.latency_share("STHN W_S = 1536") == pytest.approx(0.0072, abs=5e-5)
    assert quoted.latency_share("STHN W_S = 1536, two stages") == pytest.approx(0.013, abs=5e-5)


def test_the_papers_tables_are_whole() -> None:
    data = quoted.paper()
    assert len(data["table_1"]["rows"]) == 16 and len(data["table_3"]["noise"]) == 10
    for row in data["table_1"]["rows"]:
        assert len(row["mace_m"]) == 5
    for row in data["table_3"]["rows"]:
        assert len(row["mace_m"]) == len(row["ce_m"]) == 10
    assert data["table_1"]["rows"][-1]["mace_m"][-1] == data["table_3"]["rows"][1]["mace_m"][0] == 12.70


PAPERS = {"kind": "boson", "split": "test", "queries": 26568, "name": "v3/test"}


NO_NOISE = Noise()


def results(
    source: dict, errors: dict[str, list[float | None]], digest: str = "d", noise: Noise = NO_NOISE, radius: float = 512
) -> Results:
    """Stored results of these corner errors."""
    count = len(next(iter(errors.values())))
    condition = Condition(radius, noise, digest, [PairRecord(f"p{i}", "desert" if i % 2 else "water") for i in range(count)])
    cells = [
        Cell(label, 0, [PairScore(e, e, "" if e is not None else "none", 0.02, {"coarse": 0.01}) for e in values])
        for label, values in errors.items()
    ]
    return Results("made here", source, [Method(label, label, 512) for label in errors], [condition], cells)


def cells_of(table: tables.Table, row: str) -> list[str]:
    return next(r for r in table.rows if r[0] == row)


@pytest.mark.parametrize(
    ("change", "may"),
    [({}, True), ({"split": "val"}, False), ({"queries": 100}, False), ({"kind": "maps"}, False), ({"kind": "flight"}, False)],
)
def test_the_paper_is_quoted_beside_its_own_data_only(change: dict, may: bool) -> None:
    source, turned = PAPERS | change, Noise(rotation_deg=5)
    made = tables.tables([results(source, {"ours": [1.0, 3.0]}), results(source, {"ours": [2.0, 4.0]}, "n", turned)])
    texts = [table.markdown() for table in made.values()]
    assert ("quoted" in "".join(texts)) == may
    if may:
        assert cells_of(made["table_1"], "STHN W_S = 1536, two stages (quoted)")[1] == "12.70"
        assert cells_of(made["table_2"], "STGL-GeM-ResNet50 (quoted)")[1:3] == ["13.52", "4918.9"]
        assert cells_of(made["table_3"], "rotation 5")[2:] == ["31.82 / 27.00", "14.48 / 11.42"]


def test_our_numbers_stand_in_the_papers_layout() -> None:
    source = {"kind": "maps", "name": "demo"}
    errors = {"a": [1.0, 3.0, None, 30.0], "b": [2.0] * 4}
    made = tables.tables([results(source, errors), results(source, {"a": [9.0] * 4}, "other", radius=50)])
    assert made["table_1"].heads == ["method", "50", "512", "failure", "note"]
    assert cells_of(made["table_1"], "a")[1:4] == ["9.00", "11.33", "12.5 %"]
    assert cells_of(made["table_1"], "b")[1:3] == ["-", "2.00"]
    assert cells_of(made["table_2"], "a")[1:4] == ["11.33", "20.0", "coarse 10.0"]
    kinds = [f"{row[0]} {row[1]} {row[2]}" for row in made["terrain"].rows]
    assert kinds == ["desert a 512", "desert b 512", "desert a 50", "water a 512", "water b 512", "water a 50"]
    rows = list(csv.reader(io.StringIO(made["errors"].csv())))
    row = dict(zip(rows[0], rows[1], strict=True))
    assert (row["> 25 m"], row["corner > 25 m"], row["failure"], row["median"]) == ("50.0 %", "50.0 %", "25.0 %", "3.00")


def test_rows_of_other_pairs_are_refused() -> None:
    source = {"kind": "maps", "name": "demo"}
    with pytest.raises(ResultsError, match="same pairs"):
        tables.tables([results(source, {"a": [1.0]}), results(source, {"b": [1.0]}, "others")])
    with pytest.raises(ResultsError, match="one result"):
        tables.tables([results(source, {"a": [1.0]}), results(source, {"a": [2.0]})])


def test_results_come_back_as_they_were(tmp_path: Path) -> None:
    made = results({"kind": "maps", "name": "demo"}, {"a": [1.0, None]}, noise=Noise(scale=0.1))
    path = made.write(tmp_path)
    read = Results.read(tmp_path)
    assert (read.methods, read.conditions, read.cells) == (made.methods, made.conditions, made.cells)
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"schema": 7}))
    with pytest.raises(ResultsError, match="schema: expected 1, found 7"):
        Results.read(tmp_path)
    path.write_text(json.dumps({k: v for k, v in document.items() if k != "cells"}))
    with pytest.raises(ResultsError, match="cells"):
        Results.read(path)
    with pytest.raises(ResultsError, match="absent"):
        Results.read(tmp_path / "absent")


def test_noise_is_named_and_checked() -> None:
    assert run.parse_noise("perspective=16") == Noise(perspective_px=16)
    assert run.parse_noise("none") == Noise()
    for wrong in ("shear=1", "scale", "scale=0", "rotation=-5", "rotation=x"):
        with pytest.raises(ValueError, match=r"expected none, rotation=DEG"):
            run.parse_noise(wrong)
