"""The one interface of training, evaluation and rivals: a thermal frame, a satellite window, and where the frame lies.

Pixels are the contract's: x right, y down, an integer is a pixel's centre; window and frame have 1 m/px (or, for low
flights, both the same other scale). Quads are TL, TR, BL, BR.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from .. import geometry

FRAME_PX = 512

NoiseKind = Literal["none", "rotation", "scale", "perspective"]


@dataclass(frozen=True)
class Noise:
    """Geometric noise of an experiment (paper, Table III): which kinds, and their bounds. Uniform, both signs.

    In training one of the kinds with a bound above 0, or none, is drawn for each pair (`sthn-reference` 1.9).
    """

    rotation_deg: float = 0.0
    scale: float = 0.0
    perspective_px: float = 0.0
    """In pixels of the 256 px thermal input, per coordinate of each corner."""

    @property
    def kinds(self) -> tuple[NoiseKind, ...]:
        """Kinds with a bound above 0."""
        bounds: dict[NoiseKind, float] = {
            "rotation": self.rotation_deg,
            "scale": self.scale,
            "perspective": self.perspective_px,
        }
        return tuple(kind for kind, bound in bounds.items() if bound > 0)


@dataclass(frozen=True)
class Pair:
    """A frame and the window it is to be found in."""

    name: str
    """Unique within its source, the same in every run."""
    satellite: NDArray[np.uint8]
    """`[W_S, W_S, 3]`, RGB, zero where there is no map."""
    thermal: NDArray[np.uint8]
    """`[512, 512]`, gray."""
    homography: NDArray[np.float64]
    """`[3, 3]`, truth: frame px -> window px."""
    terrain: str = ""
    """Kind of ground, for tables by terrain; empty where unknown."""
    m_per_px: float = 1.0
    """Metres per pixel of window and frame alike: errors in metres are errors in window pixels times this."""
    surround: NDArray[np.uint8] | None = None
    """`[n, n]`, what the sensor saw about the frame, which is its centre crop; n - 512 is even. Noise turns and scales it,
    so that a turned frame has no empty corners. None where no more was seen."""
    seen: NDArray[np.bool_] | None = None
    """Where the sensor saw the ground, of the surround's side where there is one, else the frame's. None: everywhere."""

    @property
    def window_m(self) -> int:
        """W_S at 1 m/px."""
        return int(self.satellite.shape[0])

    @property
    def frame_seen(self) -> NDArray[np.bool_] | None:
        """`[512, 512]`, where the sensor saw the frame; None: everywhere."""
        if self.seen is None:
            return None
        margin = (self.seen.shape[0] - self.thermal.shape[0]) // 2
        inner = slice(margin, margin + self.thermal.shape[0])
        return self.seen[inner, inner]

    def quad(self) -> geometry.Quad:
        """The frame's edges in the window, truth."""
        return geometry.apply(self.homography, geometry.edge_corners(self.thermal.shape[0]))

    def centre(self) -> NDArray[np.float64]:
        """The frame's middle in the window, truth. Eq. (8)"""
        middle = (self.thermal.shape[0] - 1) / 2
        return geometry.apply(self.homography, [middle, middle])

    def displacement(self, side_px: int = 256) -> NDArray[np.float64]:
        """Truth as the published displacement `[2, 2, 2]` of the inclusive corners of a `side_px` satellite input."""
        inclusive = geometry.inclusive_of_edges(self.quad(), self.window_m / side_px)
        return geometry.displacement_of(side_px, inclusive)


class PairSource(Protocol):
    """A finite, seeded, ordered set of pairs: the same index gives the same pair in every run."""

    name: str
    window_m: int
    search_radius_m: float
    """D_C."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Pair: ...


class TrainingSource(PairSource, Protocol):
    """A source that training can draw from more than once."""

    def reseeded(self, seed: int | tuple[int, ...]) -> Self:
        """The same source with other draws: for another pass."""
        ...
