"""The correlation pyramid and its look-up. Paper Sec. III-B: the volume C, its pooled levels, radius 4."""

from __future__ import annotations

import enum

import torch
from torch import Tensor
from torch.nn import functional as F

from .homography import inverse, transform_grid

RADIUS = 4
"""Cells looked up on each side, at every level."""

WINDOW = 2 * RADIUS + 1


class Lookup(enum.Enum):
    """Direction of the look-up: which image's cells index the correlation, and where in the other they look.

    H takes frame pixels to map pixels. The published direction is geometrically inconsistent (a map cell p matches the
    frame at H^-1(p), not at H(p)); released weights were trained with it and need it. Weights belong to the direction
    they were trained with: never change it under them.
    """

    PUBLISHED = "published"
    """Map-indexed, at H(p) in the frame."""
    MAP_INDEXED = "map_indexed"
    """Map-indexed, at H^-1(p) in the frame: consistent."""
    FRAME_INDEXED = "frame_indexed"
    """Frame-indexed, at H(p) in the map: consistent."""


def correlation_pyramid(map_features: Tensor, frame_features: Tensor, levels: int, lookup: Lookup) -> list[Tensor]:
    """C[p, q] = ReLU(<f1[p], f2[q]>), neither scaled nor normalised, and its 2x2 means over q.

    The map's features may have batch 1 beside B frames. Returns `levels` tensors `[B, H*W, H/2^l, W/2^l]`, indexed by p
    (a cell of the map; of the frame where the direction is frame-indexed). ReLU comes before pooling, so pooled
    features would not give the same.
    """
    side = frame_features.shape[-1]
    first, second = map_features, frame_features
    if lookup is Lookup.FRAME_INDEXED:
        first, second = frame_features, map_features
    volume = torch.relu(first.flatten(2).transpose(1, 2) @ second.flatten(2))
    pyramid = [volume.unflatten(2, (side, side))]
    for _ in range(levels - 1):
        pyramid.append(F.avg_pool2d(pyramid[-1], 2))
    return pyramid


def lookup_coordinates(matrix: Tensor, grid: Tensor, lookup: Lookup) -> Tensor:
    """Where each cell p looks, feature pixels: `[B, 2, H, W]`. `matrix`: H on the feature grid."""
    return transform_grid(inverse(matrix) if lookup is Lookup.MAP_INDEXED else matrix, grid)


def look_up(pyramid: list[Tensor], coordinates: Tensor) -> Tensor:
    """The 9 x 9 window of every level about `coordinates` / 2^l: `[B, 81 * levels, H, W]`.

    Bilinear, zero outside. The slow index of a window moves **x**, the fast one y (the published order): channel
    81 l + 9 a + b is the sample at (x / 2^l + a - 4, y / 2^l + b - 4).

    All samples of a window share their fraction, so that a 10 x 10 patch is gathered and interpolated once per axis:
    gathers run 1.6 times as fast as GridSample in ONNX Runtime, and every runtime has them.
    """
    height, width = coordinates.shape[-2:]
    x, y = coordinates.flatten(2).unbind(1)
    channels = [_window(level, x / 2**i, y / 2**i) for i, level in enumerate(pyramid)]
    return torch.cat(channels, dim=2).transpose(1, 2).unflatten(2, (height, width))


def _taps(centre: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Indices `[B, P, 10]` inside the level, their 0/1 mask, and the fraction `[B, P]`, along one axis."""
    # Far outside nothing is seen anyway; the bound keeps the conversion to integers defined (NaN is caught below).
    centre = centre.clamp(-2.0 * size - 2 * WINDOW, 3.0 * size + 2 * WINDOW)
    base = torch.floor(centre)
    offsets = torch.arange(-RADIUS, RADIUS + 2, device=centre.device)
    index = base.long()[..., None] + offsets
    mask = ((index >= 0) & (index < size)).to(centre.dtype)
    return index.clamp(0, size - 1), mask, centre - base


def _window(level: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """`[B, P, H, W]` at `[B, P]` -> `[B, P, 81]`."""
    height, width = level.shape[-2:]
    column, column_mask, fx = _taps(x, width)
    row, row_mask, fy = _taps(y, height)
    index = row[..., :, None] * width + column[..., None, :]
    patch = torch.gather(level.flatten(2), 2, index.flatten(2)).unflatten(2, (WINDOW + 1, WINDOW + 1))
    patch = patch * row_mask[..., :, None] * column_mask[..., None, :]
    fx, fy = fx[..., None, None], fy[..., None, None]
    patch = patch[..., :, :-1] * (1 - fx) + patch[..., :, 1:] * fx
    patch = patch[..., :-1, :] * (1 - fy) + patch[..., 1:, :] * fy
    return patch.transpose(2, 3).flatten(2)
