"""Geometric noise of the paper's Table III, with a truth that is exact for all three kinds.

A draw is a homography from pixels of the noisy frame to pixels of the one recorded. The frame is resampled through it and
the truth is multiplied by it: one matrix for both, so that nothing can disagree. (The published code warps the frame and
moves the truth's corners by separate rules; they agree for rotation and scale, for perspective only nearly.)
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import geometry
from .pair import Noise, NoiseKind, Pair, PairSource

Seed = int | tuple[int, ...]

INPUT_PX = 256
"""Perspective noise is stated in pixels of the published thermal input."""

NAME_OF_NONE: NoiseKind = "none"


def words(seed: Seed, *more: int) -> list[int]:
    """A seed and further numbers as what numpy's generators take."""
    return [*(seed if isinstance(seed, tuple) else (seed,)), *more]


def draw(noise: Noise, kind: NoiseKind, frame_px: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noisy-frame px -> recorded-frame px, `[3, 3]`, for a frame of `frame_px`.

    Rotation: the frame's corners turned about its middle by U(-R, R). Scale: multiplied by f = 1 + U(-r, r) about it.
    Perspective: each coordinate of each corner moved by a whole number, uniform in -p .. p, of the 256 px input's pixels.
    """
    edges = geometry.edge_corners(frame_px)
    middle = (frame_px - 1) / 2
    if kind == "rotation":
        angle = np.radians(rng.uniform(-noise.rotation_deg, noise.rotation_deg))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        moved = (edges - middle) @ turn.T + middle
    elif kind == "scale":
        moved = (edges - middle) * (1 + rng.uniform(-noise.scale, noise.scale)) + middle
    elif kind == "perspective":
        most = int(noise.perspective_px)
        moved = edges + rng.integers(-most, most, (4, 2), endpoint=True) * (frame_px / INPUT_PX)
    else:
        return np.eye(3)
    return geometry.dlt(edges, moved)


def warp(pair: Pair, relation: NDArray[np.float64]) -> Pair:
    """The pair with its frame seen through `relation` (noisy-frame px -> frame px) and the truth with it.

    Bilinear; a frame that comes out coarser is averaged first, so that nothing aliases. 0, and not `seen`, where the sensor
    saw nothing: beyond the surround, or where there is none.
    """
    size = pair.thermal.shape[0]
    picture = pair.thermal if pair.surround is None else pair.surround
    offset = (picture.shape[0] - size) // 2
    seen = np.ones(picture.shape, np.uint8) if pair.seen is None else pair.seen.astype(np.uint8)
    moved = np.array([[1.0, 0.0, offset], [0.0, 1.0, offset], [0.0, 0.0, 1.0]]) @ relation
    shrink = np.sqrt(abs(np.linalg.det(relation[:2, :2])))
    if shrink > 1.0:
        # The triangle filter of bilinear antialiasing has variance s^2 / 6, of which interpolation itself is 1 / 6.
        picture = cv2.GaussianBlur(picture, (0, 0), float(np.sqrt(max((shrink**2 - 1) / 6, 1e-4))))
    thermal, seen = (
        cv2.warpPerspective(image, moved, (size, size), flags=how | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_CONSTANT)
        for image, how in ((picture, cv2.INTER_LINEAR), (seen, cv2.INTER_NEAREST))
    )
    homography = pair.homography @ relation
    seen = None if seen.all() else seen > 0
    return dataclasses.replace(pair, thermal=thermal, homography=homography, surround=None, seen=seen)


class Noisy:
    """A source seen through noise: the same draw for an index in every run.

    `kind`: the one to apply to every pair (an evaluation's row); None draws one of those with a bound above 0, or none,
    for each pair, as published training does.
    """

    def __init__(self, source: PairSource, noise: Noise, seed: Seed, kind: NoiseKind | None = None) -> None:
        if kind not in (None, "none", *noise.kinds):
            raise ValueError(f"noise: {kind}: expected one of {('none', *noise.kinds)} or None")
        self.source, self.noise, self.seed, self.kind = source, noise, seed, kind
        self.name = source.name
        self.window_m = source.window_m
        self.search_radius_m = source.search_radius_m

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Pair:
        rng = np.random.default_rng(words(self.seed, index, 0x4E))
        kind = self.kind or (NAME_OF_NONE, *self.noise.kinds)[int(rng.integers(0, len(self.noise.kinds) + 1))]
        pair = self.source[index]
        return pair if kind == NAME_OF_NONE else warp(pair, draw(self.noise, kind, pair.thermal.shape[0], rng))

    def reseeded(self, seed: Seed) -> Noisy:
        """The same source with other draws: for another pass of a training."""
        return Noisy(self.source.reseeded(seed), self.noise, seed, self.kind)
