"""The extended set: thermal painted over ground that no camera has seen.

Two forms: an HDF5 file in the published layout (`sthn.data.boson`), tiles on a lattice of 35 px; or a whole map's thermal
as a GeoTIFF on the map's own grid, from which any training can cut frames.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from ..data import boson
from .checkpoint import TgmError
from .networks import Generator
from .pairs import to_pixels, to_unit

STRIDE_PX = 35
"""Of the published database, map pixels."""

MAX_SCALE_ERROR = 0.02
"""Of a map that an extended set is made of: frames of the published layout are at 1 m/px."""

MIN_VALID = 0.99
"""Share of a tile that must have map."""


@dataclass(frozen=True)
class Region:
    """Rows and columns of a map, inclusive, that no tile's centre may lie in (published: the test region)."""

    top: int
    left: int
    bottom: int
    right: int

    def holds(self, row: int, column: int) -> bool:
        """Whether a centre lies in it."""
        return self.top <= row <= self.bottom and self.left <= column <= self.right


PUBLISHED_TEST = Region(270, 1400, 2710, 9400)
"""Of the published map, about which the extended set of its third release is cut."""


def excluded(text: str) -> list[Region]:
    """`published`, `none` or `r0,r1,c0,c1`: rows, then columns."""
    if text in ("published", "none"):
        return [PUBLISHED_TEST] if text == "published" else []
    try:
        top, bottom, left, right = map(int, text.split(","))
        if top > bottom or left > right:
            raise ValueError
    except ValueError:
        raise TgmError(f"exclude: expected published, none or r0,r1,c0,c1 with r0 <= r1, c0 <= c1, found {text}") from None
    return [Region(top, left, bottom, right)]


def centres(
    map_rgb: NDArray[np.uint8], tile_px: int, stride_px: int, excluded: Sequence[Region] = ()
) -> Iterator[tuple[int, int]]:
    """Row and column of every tile's centre on the lattice, where the tile lies on valid map. The tile's first row is
    row - tile_px // 2."""
    height, width = map_rgb.shape[:2]
    half = tile_px // 2
    for row in range(half, height - tile_px + half + 1, stride_px):
        for column in range(half, width - tile_px + half + 1, stride_px):
            tile = map_rgb[row - half : row - half + tile_px : 8, column - half : column - half + tile_px : 8]
            if tile.any(axis=2).mean() >= MIN_VALID and not any(region.holds(row, column) for region in excluded):
                yield row, column


@torch.no_grad()
def paint(net: Generator, tiles: NDArray[np.uint8], size_px: int, device: str = "cpu") -> NDArray[np.uint8]:
    """Satellite tiles `[B, m, m, 3]`, resized to the network's `size_px` -> thermal `[B, n, n]` at `size_px`."""
    if size_px % 2**net.downs:
        raise TgmError(f"size_px: expected a multiple of 2^downs = {2**net.downs}, found {size_px}")
    resized = [t if t.shape[0] == size_px else cv2.resize(t, (size_px, size_px), interpolation=cv2.INTER_AREA) for t in tiles]
    painted = net(torch.stack([to_unit(t) for t in resized]).to(device)).cpu()
    return to_pixels(painted)[:, 0]


def write_extended(
    net: Generator,
    map_rgb: NDArray[np.uint8],
    path: Path,
    tile_px: int,
    size_px: int,
    stride_px: int = STRIDE_PX,
    excluded: Sequence[Region] = (),
    batch: int = 16,
    device: str = "cpu",
) -> list[tuple[int, int]]:
    """The extended set of a map -> rows and columns of its frames. Written beside and renamed: a stopped run leaves no
    half file.

    `tile_px`: map pixels under a frame, and of the stored frame; `size_px`: of the network.
    """
    places = list(centres(map_rgb, tile_px, stride_px, excluded))
    if not places:
        raise TgmError(f"{path}: no tile of {tile_px} px lies on valid map outside the excluded regions")
    half = tile_px // 2

    def frames() -> Iterator[NDArray[np.uint8]]:
        for first in tqdm(range(0, len(places), batch), "tiles", file=sys.stderr, mininterval=5):
            some = places[first : first + batch]
            tiles = np.stack([map_rgb[r - half : r - half + tile_px, c - half : c - half + tile_px] for r, c in some])
            for gray in paint(net, tiles, size_px, device):
                yield gray if size_px == tile_px else cv2.resize(gray, (tile_px, tile_px), interpolation=cv2.INTER_LINEAR)

    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".tmp")
    boson.write(unfinished, frames(), places)
    unfinished.replace(path)
    return places


def thermal_of_map(
    net: Generator, map_rgb: NDArray[np.uint8], tile_px: int, size_px: int, batch: int = 8, device: str = "cpu"
) -> NDArray[np.uint8]:
    """`[H, W]`: the map's thermal on its own grid; tiles overlap by half and are blended, 0 where there is no map."""
    height, width = map_rgb.shape[:2]
    scale = size_px / tile_px
    rows, columns = round(height * scale), round(width * scale)
    small = cv2.resize(map_rgb, (columns, rows), interpolation=cv2.INTER_AREA)
    pad_bottom, pad_right = max(0, size_px - rows), max(0, size_px - columns)
    small = np.pad(small, ((0, pad_bottom), (0, pad_right), (0, 0)), mode="reflect") if pad_bottom or pad_right else small
    total, weight = (np.zeros(small.shape[:2], np.float32) for _ in range(2))
    ramp = np.minimum(np.arange(size_px) + 1, size_px - np.arange(size_px)).astype(np.float32)
    window = ramp[:, None] * ramp[None]
    step = size_px // 2

    def starts(size: int) -> list[int]:
        return [*range(0, size - size_px, step), size - size_px]

    places = [(y, x) for y in starts(small.shape[0]) for x in starts(small.shape[1])]
    for first in tqdm(range(0, len(places), batch), "tiles", file=sys.stderr, mininterval=5):
        some = places[first : first + batch]
        tiles = np.stack([small[y : y + size_px, x : x + size_px] for y, x in some])
        for (y, x), gray in zip(some, paint(net, tiles, size_px, device), strict=True):
            total[y : y + size_px, x : x + size_px] += gray * window
            weight[y : y + size_px, x : x + size_px] += window
    gray = (total / weight)[:rows, :columns]
    whole = cv2.resize(gray, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.clip(np.round(whole), 1, 255).astype(np.uint8) * map_rgb.any(axis=2)


def write_thermal_map(gray: NDArray[np.uint8], like: Path, path: Path) -> None:
    """A one-band GeoTIFF on the grid of the map `like`; 0 is no data."""
    with rasterio.open(like) as source:
        profile = {"crs": source.crs, "transform": source.transform, "nodata": 0, "compress": "deflate", "tiled": True}
    height, width = gray.shape
    with rasterio.open(path, "w", driver="GTiff", height=height, width=width, count=1, dtype="uint8", **profile) as target:
        target.write(gray, 1)
