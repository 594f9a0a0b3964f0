"""What the TGM learns from: satellite and thermal of the same ground, pixel on pixel."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset
from tqdm import tqdm

from ..data.pair import Pair, PairSource

MAX_BLACK_PX = 50
"""Frames with more pixels of value 0 are removed (published): there the mosaic has nothing. Frames that are stretched to
the full range have honest zeros and need a higher bound."""


def aligned(pair: Pair, size_px: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The satellite under the frame `[n, n, 3]` and the frame `[n, n]`: the window is cut through the pair's truth, so
    that pairs of any source will do."""
    frame_px = pair.thermal.shape[0]
    satellite = cv2.warpPerspective(
        pair.satellite, pair.homography, (frame_px, frame_px), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    if frame_px == size_px:
        return satellite, pair.thermal
    interpolation = cv2.INTER_AREA if frame_px > size_px else cv2.INTER_LINEAR
    return (
        cv2.resize(satellite, (size_px, size_px), interpolation=interpolation),
        cv2.resize(pair.thermal, (size_px, size_px), interpolation=interpolation),
    )


def usable_indices(source: PairSource, max_black_px: int = MAX_BLACK_PX, quiet: bool = True) -> list[int]:
    """Indices of a source whose frames may be learnt from. Reads it once."""
    numbers = tqdm(range(len(source)), f"frames of {source.name}", file=sys.stderr, disable=quiet)
    return [i for i in numbers if int((source[i].thermal == 0).sum()) <= max_black_px]


def to_unit(image: NDArray[np.uint8]) -> Tensor:
    """u8 `[n, n]` or `[n, n, C]` -> f32 `[C, n, n]` in -1..1."""
    planes = image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0)
    return torch.from_numpy(np.ascontiguousarray(planes, dtype=np.float32)) / 127.5 - 1


def to_pixels(unit: Tensor) -> NDArray[np.uint8]:
    """`[..., n, n]` in -1..1, clamped -> u8."""
    return ((unit.clamp(-1, 1) + 1) * 127.5).round().to(torch.uint8).numpy()


class AlignedPairs(Dataset):
    """Satellite `[3, n, n]` and thermal `[1, n, n]`, both in -1..1."""

    def __init__(self, source: PairSource, indices: Sequence[int], size_px: int) -> None:
        self.source, self.indices, self.size_px = source, indices, size_px

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        satellite, thermal = aligned(self.source[self.indices[index]], self.size_px)
        return to_unit(satellite), to_unit(thermal)
