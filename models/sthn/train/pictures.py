"""Predictions as the paper draws them: truth green, coarse blue, final red, the frame beside its window."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import geometry

GREEN, BLUE, RED = (0, 200, 0), (40, 80, 255), (230, 20, 20)
SIDE_PX = 320
JPEG_QUALITY = 80


def panel(
    window: NDArray[np.uint8], thermal: NDArray[np.uint8], quads: list[tuple[geometry.Quad, tuple[int, int, int]]]
) -> NDArray[np.uint8]:
    """A window with quads (edges, window px, TL TR BL BR) and the frame to its right, `[SIDE, 2 SIDE, 3]`, RGB."""
    scale = SIDE_PX / window.shape[0]
    canvas = cv2.resize(window, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    for quad, colour in quads:
        if np.isfinite(quad).all():
            around = np.clip((quad[[0, 1, 3, 2]] + 0.5) * scale - 0.5, -4 * SIDE_PX, 4 * SIDE_PX)
            points = np.round(around * 16).astype(np.int32)[None]
            cv2.polylines(canvas, points, True, colour, 2, cv2.LINE_AA, shift=4)
    frame = cv2.resize(thermal, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    return np.hstack([canvas, np.repeat(frame[..., None], 3, 2)])


def sheet(path: Path, panels: list[NDArray[np.uint8]], columns: int = 2) -> None:
    """Panels in rows, as JPEG."""
    blank = np.full_like(panels[0], 255)
    padded = panels + [blank] * (-len(panels) % columns)
    rows = [np.hstack(padded[i : i + columns]) for i in range(0, len(padded), columns)]
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = np.vstack(rows)[..., ::-1]
    if not cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]):
        raise OSError(f"{path}: not written")
