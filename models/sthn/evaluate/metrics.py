"""MACE, CE and their distributions, in metres.

The corner error of a pair is the mean distance of the frame's four corners from where they are, the centre error that of
its middle (Eq. 8); MACE and CE are their means. Both are the published numbers: corners of inclusive pixels times alpha
and edges in the window differ by the same constant in truth and answer, and the middle is (W - 1) / 2, not W / 2.

A pair without an answer has no error. As in the paper its share, the failure rate, stands apart, and means and
percentiles are those of the answered pairs; the shares above 25 m and 50 m are of all pairs, unanswered ones among them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import geometry
from ..data import Pair

FAILURE_M = 25.0
"""Above this a pair counts as lost, metres. The authors' plots write 4.167 = 25 / 6, in pixels of the 256 px input at
W_S = 1536."""
FAR_M = 50.0


class NoAnswer(ValueError):
    """Why a homography gives no error."""


@dataclass(frozen=True)
class Score:
    """One pair, one method."""

    corner_m: float | None
    """None: no answer."""
    centre_m: float | None
    reason: str = ""
    """Why there is no answer."""


def errors_m(pair: Pair, homography: ArrayLike) -> tuple[float, float]:
    """Corner error and centre error of a homography, frame px -> window px, metres. [`NoAnswer`] where not finite."""
    matrix = np.asarray(homography, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise NoAnswer(f"homography: expected [3, 3], found {list(matrix.shape)}")
    middle = (pair.thermal.shape[0] - 1) / 2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        corners = geometry.apply(matrix, geometry.edge_corners(pair.thermal.shape[0]))
        centre = geometry.apply(matrix, [middle, middle])
        corner_px = np.linalg.norm(corners - pair.quad(), axis=1).mean()
        centre_px = np.linalg.norm(centre - pair.centre())
    if not (math.isfinite(corner_px) and math.isfinite(centre_px)):
        raise NoAnswer("homography: a corner or the centre goes to infinity")
    return float(corner_px) * pair.m_per_px, float(centre_px) * pair.m_per_px


def score(pair: Pair, homography: NDArray[np.float64] | None, reason: str = "") -> Score:
    """The score of an answer, or of none."""
    if homography is None:
        return Score(None, None, reason or "no answer")
    try:
        return Score(*errors_m(pair, homography))
    except NoAnswer as error:
        return Score(None, None, str(error))


@dataclass(frozen=True)
class Distribution:
    """Of one kind of error, metres; None where no pair was answered."""

    mean_m: float | None
    median_m: float | None
    p95_m: float | None
    p99_m: float | None
    over_25m: float
    """Share of all pairs, unanswered ones among them."""
    over_50m: float

    @classmethod
    def of(cls, errors: list[float | None]) -> Distribution:
        """Linear percentiles, as the contract's metrics have."""
        answered = np.array([e for e in errors if e is not None], dtype=np.float64)
        everything = np.array([np.inf if e is None else e for e in errors], dtype=np.float64)
        over = [float((everything > bound).mean()) if len(errors) else 0.0 for bound in (FAILURE_M, FAR_M)]
        if not len(answered):
            return cls(None, None, None, None, *over)
        middle = (float(np.percentile(answered, q)) for q in (50, 95, 99))
        return cls(float(answered.mean()), *middle, *over)


@dataclass(frozen=True)
class Summary:
    """All pairs of a condition, one method."""

    pairs: int
    failures: int
    """Pairs without an answer."""
    corner: Distribution
    """Its mean is MACE."""
    centre: Distribution
    """Its mean is CE."""

    @property
    def failure_rate(self) -> float:
        """Share of pairs without an answer."""
        return self.failures / self.pairs if self.pairs else 0.0

    @property
    def mace_m(self) -> float | None:
        """Mean average corner error."""
        return self.corner.mean_m

    @property
    def ce_m(self) -> float | None:
        """Mean centre error."""
        return self.centre.mean_m

    @classmethod
    def of(cls, scores: Iterable[Score]) -> Summary:
        """Of any scores that have `corner_m` and `centre_m`."""
        scores = list(scores)
        corner, centre = [s.corner_m for s in scores], [s.centre_m for s in scores]
        return cls(len(scores), sum(c is None for c in corner), Distribution.of(corner), Distribution.of(centre))

    def to_dict(self) -> dict:
        """For JSON."""
        return asdict(self) | {"failure_rate": self.failure_rate}
