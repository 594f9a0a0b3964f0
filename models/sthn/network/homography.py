"""The four-point homography in closed form, and how it moves the feature grid.

A displacement is `[B, 2, 2, 2]`: x|y, top|bottom, left|right, in pixels of the stage's input, from the identity
corners (0, 0) .. (W_R - 1, W_R - 1). The homography takes frame pixels to map pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor


def square_to_quad(corners: Tensor, side: float) -> Tensor:
    """The homography of the square (0, 0) .. (side, side) onto a quad.

    `corners`: `[B, 2, 2, 2]` (x|y, top|bottom, left|right). Returns `[B, 3, 3]` with `[2][2] = 1`. A quad with three
    corners in a line gives values that are not finite.

    Reference: Heckbert, Fundamentals of Texture Mapping and Image Warping, 1989, Sec. 2.2.3.
    """
    tl, tr, bl, br = corners[:, :, 0, 0], corners[:, :, 0, 1], corners[:, :, 1, 0], corners[:, :, 1, 1]
    total = tl - tr + br - bl
    right, below = tr - br, bl - br
    area = right[:, 0] * below[:, 1] - below[:, 0] * right[:, 1]
    g = (total[:, 0] * below[:, 1] - below[:, 0] * total[:, 1]) / area
    h = (right[:, 0] * total[:, 1] - total[:, 0] * right[:, 1]) / area
    column_u = tr - tl + g[:, None] * tr
    column_v = bl - tl + h[:, None] * bl
    top_rows = torch.stack([column_u / side, column_v / side, tl], dim=2)
    # area / area is 1 for every frame: the exporter would fix the batch of a tensor made of ones.
    bottom_row = torch.stack([g / side, h / side, area / area], dim=1)[:, None, :]
    return torch.cat([top_rows, bottom_row], dim=1)


def inverse(matrix: Tensor) -> Tensor:
    """The inverse of `[B, 3, 3]` up to scale (the adjugate), without a linear solver: exporters know none."""
    a, b, c = matrix.unbind(1)
    return torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=2)


def identity_grid(side: int, like: Tensor) -> Tensor:
    """`[1, 2, side, side]`: x and y of each cell, x fast."""
    line = torch.arange(side, dtype=like.dtype, device=like.device)
    return torch.stack([line[None, :].expand(side, side), line[:, None].expand(side, side)])[None]


def transform_grid(matrix: Tensor, grid: Tensor) -> Tensor:
    """`[B, 3, 3]` applied to `[1, 2, H, W]` -> `[B, 2, H, W]`."""
    x, y = grid[:, 0], grid[:, 1]

    def row(i: int) -> Tensor:
        return matrix[:, i, 0, None, None] * x + matrix[:, i, 1, None, None] * y + matrix[:, i, 2, None, None]

    w = row(2)
    return torch.stack([row(0) / w, row(1) / w], dim=1)


def feature_homography(displacement: Tensor, feature_side: int) -> Tensor:
    """The homography of a displacement (input pixels) on the feature grid, a quarter of the input: corners
    (0, 0) .. (side - 1, side - 1), displacement / 4."""
    last = float(feature_side - 1)
    corners = displacement.new_tensor([[[0.0, last], [0.0, last]], [[0.0, 0.0], [last, last]]])
    return square_to_quad(corners + displacement / 4, last)
