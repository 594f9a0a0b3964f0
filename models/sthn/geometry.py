"""Corners, edges and homographies in numpy, in the contract's pixel frames (`src/homography/`).

Quads are `[4, 2]`, TL, TR, BL, BR. x right, y down, an integer is a pixel's centre: a square of n pixels has its edges at
-0.5 and n - 0.5. Displacements are `[2, 2, 2]` (x|y, top|bottom, left|right) in pixels of a stage's map input, from the
inclusive corners (0, 0) .. (R - 1, R - 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Quad = NDArray[np.float64]

RIGHT_BOTTOM = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
"""Which corner is right (x) and bottom (y)."""


def inclusive_corners(side_px: int) -> Quad:
    """(0, 0) .. (side - 1, side - 1)."""
    return RIGHT_BOTTOM * (side_px - 1)


def edge_corners(side_px: float) -> Quad:
    """(-0.5, -0.5) .. (side - 0.5, side - 0.5)."""
    return RIGHT_BOTTOM * side_px - 0.5


def displaced(side_px: int, displacement: ArrayLike) -> Quad:
    """The inclusive corners, moved."""
    return inclusive_corners(side_px) + np.asarray(displacement, dtype=np.float64).reshape(2, 4).T


def displacement_of(side_px: int, quad: Quad) -> NDArray[np.float64]:
    """Inverse of [`displaced`]."""
    return (quad - inclusive_corners(side_px)).T.reshape(2, 2, 2)


def edges_of_inclusive(quad: Quad, m_per_px: float, margin_px: float = 0.0) -> Quad:
    """Inclusive corners of a stage's map input -> edges in window px at 1 m/px: left * alpha, (right + 1) * alpha, then
    - 0.5. A perfect fit has scale 1.000. `margin_px`: what the map input covers beyond the window."""
    return (quad + RIGHT_BOTTOM) * m_per_px - 0.5 - margin_px


def inclusive_of_edges(quad: Quad, m_per_px: float, margin_px: float = 0.0) -> Quad:
    """Inverse of [`edges_of_inclusive`]."""
    return (quad + margin_px + 0.5) / m_per_px - RIGHT_BOTTOM


def dlt(source: ArrayLike, target: ArrayLike) -> NDArray[np.float64]:
    """The homography of at least four point pairs, `[3, 3]` with `[2][2] = 1`: exact for four, else least squares.

    Reference: Hartley & Zisserman, Multiple View Geometry, 2nd ed., Alg. 4.2. Raises ValueError for points that are not
    finite or lie in a line.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if len(source) < 4 or source.shape != target.shape:
        raise ValueError(f"homography: expected at least 4 point pairs, found {source.shape} and {target.shape}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("homography: expected finite points")
    (a, from_unit), (b, to_unit) = _normalised(source), _normalised(target)
    ones, zeros = np.ones(len(a)), np.zeros((len(a), 3))
    homogeneous = np.column_stack([a, ones])
    rows = np.concatenate(
        [
            np.hstack([homogeneous, zeros, -b[:, :1] * homogeneous]),
            np.hstack([zeros, homogeneous, -b[:, 1:] * homogeneous]),
        ]
    )
    _, singular, basis = np.linalg.svd(rows)
    if singular[7] < 1e-10 * singular[0]:
        raise ValueError("homography: the points are degenerate")
    matrix = np.linalg.inv(to_unit) @ basis[8].reshape(3, 3) @ from_unit
    if abs(matrix[2, 2]) < 1e-12 * np.abs(matrix).max():
        raise ValueError("homography: the points are degenerate")
    return matrix / matrix[2, 2]


def _normalised(points: Quad) -> tuple[Quad, NDArray[np.float64]]:
    """Points about their mean at a mean distance of sqrt 2, and the matrix that takes them there."""
    centre = points.mean(0)
    distance = np.hypot(*(points - centre).T).mean()
    if distance == 0:
        raise ValueError("homography: the points are degenerate")
    scale = np.sqrt(2) / distance
    return (points - centre) * scale, np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])


def apply(homography: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """`[..., 2]` points through a homography."""
    points = np.asarray(points, dtype=np.float64)
    matrix = np.asarray(homography, dtype=np.float64)
    mapped = points @ matrix[:, :2].T + matrix[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def homography_of_edges(frame_px: int, quad: Quad) -> NDArray[np.float64]:
    """Rectified-frame px -> window px: the frame's edges onto a quad of edges."""
    return dlt(edge_corners(frame_px), quad)


def homography_of_displacement(
    frame_px: int, side_px: int, displacement: ArrayLike, m_per_px: float, margin_px: float = 0.0
) -> NDArray[np.float64]:
    """Rectified-frame px -> window px, from a displacement of inclusive corners of the coarse map input."""
    return homography_of_edges(frame_px, edges_of_inclusive(displaced(side_px, displacement), m_per_px, margin_px))
