"""The one interface of all rivals: a pair in, a homography or a failure out, with the time it took.

Seconds are wall time of the whole match, images as decoded pixels; no data loading. Retrieval methods state the time
that the paper's formula gives instead (`retrieval.py`) and say so in `detail`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..data.pair import Pair

NO_WEIGHTS = "no weights here"
"""Note of a rival whose weights were not given."""

MIN_MATCHES = 10
"""Keypoint methods fail at this many matches or fewer (paper, Sec. IV)."""


class RivalError(ValueError):
    """A rival that is asked for wrongly. The text names the rival, the expected and the found."""


@dataclass(frozen=True)
class Match:
    """What a rival says of a pair."""

    homography: NDArray[np.float64] | None
    """`[3, 3]`: frame px -> window px, integers at pixel centres; None where it failed."""
    seconds: float
    detail: dict[str, float | int | str] = field(default_factory=dict)
    """What speaks for it (matches, inliers), or why it failed (`failure`)."""

    @property
    def failed(self) -> bool:
        """Counted in the failure rate, and in no mean."""
        return self.homography is None


class Rival(Protocol):
    """A method, one row of a table."""

    name: str
    """As the tables print it."""
    window_m: int | None
    """The only W_S it works at, metres of ground; None for any."""
    note: str
    """Stands beside its row: "short run, 400 steps", "no weights here"; empty where there is nothing to add."""
    ready: bool
    """Whether it can match here. A row of one that cannot holds its note and no number."""

    def match(self, pair: Pair) -> Match:
        """Finds the pair's frame in the pair's window. Never looks at the truth."""
        ...


@dataclass(frozen=True)
class Unready:
    """A rival that cannot run here: its row says why."""

    name: str
    note: str
    window_m: int | None = None
    ready: bool = False

    def match(self, pair: Pair) -> Match:
        """Always an error: there is no number to give."""
        raise RivalError(f"{self.name}: cannot match {pair.name}: {self.note}")


def ground_m(pair: Pair) -> int:
    """W_S on the ground."""
    return round(pair.window_m * pair.m_per_px)


def check_window(rival: Rival, pair: Pair) -> None:
    """A window of another width is an error, not a bad answer."""
    if rival.window_m is not None and ground_m(pair) != rival.window_m:
        raise RivalError(f"{rival.name}: pair {pair.name}: expected a window of {rival.window_m} m, found {ground_m(pair)} m")


def translation(x: float, y: float) -> NDArray[np.float64]:
    """`[3, 3]`: frame px -> window px for an unturned frame whose first pixel lies at (x, y)."""
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def centred(pair: Pair) -> NDArray[np.float64]:
    """The frame in the middle of the window, unturned."""
    offset = (pair.window_m - pair.thermal.shape[0]) / 2
    return translation(offset, offset)
