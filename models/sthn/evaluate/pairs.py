"""One pair for methods of every W_S: the widest window is made once, the others are its middle."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..data import Pair


def narrowed(pair: Pair, side_px: int) -> Pair:
    """The same pair in a window of `side_px` about the same middle; its homography moves with the window's corner."""
    side = pair.satellite.shape[0]
    if side_px == side:
        return pair
    if side_px > side or (side - side_px) % 2:
        raise ValueError(f"{pair.name}: window: expected at most {side} px and an even difference, found {side_px}")
    rim = (side - side_px) // 2
    move = np.array([[1.0, 0.0, -rim], [0.0, 1.0, -rim], [0.0, 0.0, 1.0]])
    homography = move @ pair.homography
    satellite = np.ascontiguousarray(pair.satellite[rim : side - rim, rim : side - rim])
    return dataclasses.replace(pair, satellite=satellite, homography=homography / homography[2, 2])
