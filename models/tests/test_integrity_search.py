"""The trials of the search: what confirms what, and what is counted."""

import math

import pytest

from sthn.integrity import search
from sthn.integrity.search import Candidate, Frame

HOME = (25.2, 55.3)


def frame(stamp_s: float, east_m: float | None, error_m: float = 1.0) -> Frame:
    """A candidate east of home, or none."""
    candidate = None
    if east_m is not None:
        candidate = Candidate(stamp_s, *search.moved(*HOME, east_m, 0.0), error_m)
    return Frame(candidate, "fix" if candidate else "low_evidence", 4.0, 100.0, 10.0)


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([frame(0, 0), frame(5, 100)], (2, 1.0)),
        ([frame(0, None), frame(5, 100), frame(10, 200)], (3, 1.0)),
        # Nobody flies 3 km in 5 s: neither confirms the other, the third confirms the first.
        ([frame(0, 0), frame(5, 3000, 3000.0), frame(10, 200)], (3, 1.0)),
        # The same ground at the same time is one picture.
        ([frame(0, 0), frame(1, 20)], None),
        ([frame(0, 0)], None),
        ([frame(0, 4000, 4000.0), frame(5, 4050, 4050.0)], (2, 4050.0)),
    ],
)
def test_a_candidate_is_confirmed_from_where_it_can_have_been_reached(frames, expected):
    assert search.confirmed_at(frames) == expected


def test_shares_count_trials_and_a_wrong_place_is_always_wrong():
    found = [frame(0, 0), frame(5, 100), frame(10, None), frame(15, None), frame(20, None)]
    late = [frame(0, 3000, 3000.0), frame(5, None), frame(10, None), frame(15, 0), frame(20, 100)]
    s = search.summary([found, late])
    assert (s["first_right"], s["first_wrong"], s["candidates"], s["candidates_wrong"]) == (0.5, 0.5, 5, 1)
    assert (s["right_after_2"], s["right_after_3"], s["right_after_5"], s["wrong_after_5"]) == (0.5, 0.5, 1.0, 0.0)
    elsewhere = search.summary([found], right=False)
    assert (elsewhere["first_right"], elsewhere["wrong_after_2"], elsewhere["confirmed_wrong"]) == (0.0, 1.0, 1)
    assert len(search.table([("all", 4, s)])) == 3


def test_what_is_held_back_is_a_candidate_and_what_a_gate_refused_is_not():
    evidence = {"search_east_m": 300.0, "search_north_m": -40.0, "search_km2": 3.5}
    line = {
        "stamp_ns": 7_000_000_000,
        "status": "no_fix",
        "reason": "held_back",
        "evidence": evidence,
        "latency_ms": {"total": 900.0, "search_correlate": 30.0},
        "prior": {"lat_deg": HOME[0], "lon_deg": HOME[1]},
    }
    found = search.read(line, search.moved(*HOME, 300.0, -40.0))
    assert found.candidate.error_m < 1e-3 and found.candidate.stamp_s == 7.0 and found.searched_km2 == 3.5
    assert search.read(line | {"reason": "ambiguous"}, HOME).candidate is None
    assert search.read(line | {"evidence": {}}, HOME).candidate is None


def test_a_disc_has_its_area():
    assert math.pi * search.radius_of(16) ** 2 == pytest.approx(16e6)
