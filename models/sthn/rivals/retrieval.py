"""Localisation by retrieval: the frame's descriptor against those of tiles all over the search area (paper, Table II).

Tiles have the frame's size and stand 35 px apart; their centres cover (W_S - 512)^2: N_S = 29^2 = 841 for the
1024 m x 1024 m of D_C = 512 m, in a window of 1536 m. The answer is the nearest tile, unturned. Latency is the paper's
t_e (N_S + 1) + t_m: one descriptor costs t_e, comparing them t_m; nothing is cached.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..data.pair import Pair
from ..network.encoder import normalise
from .aggregation import GeM, L2Norm, NetVlad, vlad
from .base import NO_WEIGHTS, Match, Rival, RivalError, Unready, check_window, translation
from .dinov2 import PATCH_PX, DinoV2
from .resnet import BLOCKS, resnet50_conv4

STRIDE_PX = 35
WINDOW_M = 1536
THERMAL_CONTRAST = 3.0
"""The STGL baselines were trained on thermal of three times the contrast about its mean."""
ANYLOC_LAYER = 31

Describe = Callable[[Tensor], Tensor]
"""Images `[B, 3, n, n]` in 0..1 -> unit vectors `[B, D]`."""


def tile_origins(window_px: int, frame_px: int, stride_px: int = STRIDE_PX) -> NDArray[np.int64]:
    """x and y of the first pixel of every tile, `[N_S, 2]`: a lattice about the window's middle."""
    spare = window_px - frame_px
    count = max(1, spare // stride_px)
    line = spare // 2 + (np.arange(count) - (count - 1) // 2) * stride_px
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)


def latency_s(describe_s: float, compare_s: float, tiles: int) -> float:
    """t_e (N_S + 1) + t_m, seconds."""
    return describe_s * (tiles + 1) + compare_s


def contrast(thermal: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    """Contrast about the mean gray, clipped."""
    return np.clip((thermal.astype(np.float32) - thermal.mean()) * factor + thermal.mean(), 0, 255).astype(np.uint8)


@dataclass
class Retrieval:
    """A descriptor and the lattice of tiles."""

    name: str
    describe: Describe
    thermal_contrast: float = 1.0
    window_m: int | None = WINDOW_M
    stride_px: int = STRIDE_PX
    batch: int = 16
    note: str = ""
    ready: bool = True

    @torch.no_grad()
    def match(self, pair: Pair) -> Match:
        """The nearest tile."""
        check_window(self, pair)
        frame_px = pair.thermal.shape[0]
        origins = tile_origins(pair.satellite.shape[0], frame_px, self.stride_px)
        thermal = contrast(pair.thermal, self.thermal_contrast)
        began = time.perf_counter()
        own = self.describe(_images(np.repeat(thermal[None, ..., None], 3, -1)))
        tiles = []
        for first in range(0, len(origins), self.batch):
            cut = [pair.satellite[y : y + frame_px, x : x + frame_px] for x, y in origins[first : first + self.batch]]
            tiles.append(self.describe(_images(np.stack(cut))))
        described = time.perf_counter()
        distance = (torch.cat(tiles) - own).square().sum(1)
        best = int(distance.argmin())
        compared = time.perf_counter()
        t_e, t_m = (described - began) / (len(origins) + 1), compared - described
        detail = {"tiles": len(origins), "t_e_s": t_e, "t_m_s": t_m, "distance": float(distance[best])}
        return Match(translation(*origins[best]), latency_s(t_e, t_m, len(origins)), detail)


def _images(pixels: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(pixels, -1, 1))).float() / 255


class Stgl(nn.Module):
    """ResNet-50 to its fourth stage, NetVLAD or GeM, and a linear layer where the weights have one. Keys as published.

    Reference: Xiao et al., Long-range UAV Thermal Geo-localization with Satellite Imagery, IROS 2023.
    """

    def __init__(
        self, kind: str, clusters: int = 64, out: int | None = 4096, width: int = 64, blocks: tuple[int, int, int] = BLOCKS
    ) -> None:
        super().__init__()
        channels = 16 * width
        self.backbone = resnet50_conv4(width, blocks)
        if kind == "netvlad":
            pool: nn.Module = NetVlad(clusters, channels)
            channels *= clusters
        else:
            pool = nn.Sequential(L2Norm(), GeM())
        self.aggregation = pool if out is None else nn.Sequential(pool, nn.Linear(channels, out), L2Norm())

    def forward(self, image: Tensor) -> Tensor:
        return nn.functional.normalize(self.aggregation(self.backbone(normalise(image))), dim=1)


def read_state(path: Path, field: str | None) -> dict[str, Tensor]:
    """Weights without `module.`; `field`: the table's key that may hold them."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for a file that is missing, cut or not a checkpoint
        raise RivalError(f"{path}: {error}") from error
    if isinstance(state, dict) and field in state:
        state = state[field]
    if not isinstance(state, dict) or not state or not all(isinstance(value, Tensor) for value in state.values()):
        raise RivalError(f"{path}: expected a table of tensors{f', or one under {field}' if field else ''}")
    return {key.removeprefix("module."): value for key, value in state.items()}


def load_into(net: nn.Module, state: dict[str, Tensor], path: Path) -> None:
    """Strictly; the error names the keys."""
    try:
        net.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise RivalError(f"{path}: {error}") from error
    net.eval()


def load_stgl(kind: str, path: Path | None) -> Rival:
    """`kind`: netvlad or gem; `path`: a released `best_model.pth` (`model_state_dict`). Sizes are read from the weights."""
    name = {"netvlad": "STGL-NetVLAD-ResNet50", "gem": "STGL-GeM-ResNet50"}[kind]
    if path is None:
        return Unready(name, NO_WEIGHTS, WINDOW_M)
    state = read_state(path, "model_state_dict")
    first, linear = state.get("backbone.0.weight"), state.get("aggregation.1.weight")
    if first is None:
        raise RivalError(f"{path}: missing backbone.0.weight")
    out = len(linear) if linear is not None and linear.ndim == 2 else None
    centroids = state.get("aggregation.0.centroids" if out else "aggregation.centroids")
    stages = [{key.split(".")[2] for key in state if key.startswith(f"backbone.{index}.")} for index in (4, 5, 6)]
    blocks = tuple(max(1, len(stage)) for stage in stages)
    net = Stgl(kind, 64 if centroids is None else len(centroids), out, len(first), blocks)
    load_into(net, state, path)
    return Retrieval(name, net, THERMAL_CONTRAST)


def load_anyloc(folder: Path | None) -> Rival:
    """`folder`: `dinov2.pth` (a released backbone; the paper's is ViT-g/14) and `c_centers.pt`, the vocabulary `[K, C]` of
    its layer's values."""
    name = "AnyLoc-VLAD-DINOv2"
    if folder is None:
        return Unready(name, NO_WEIGHTS, WINDOW_M)
    path, vocabulary = folder / "dinov2.pth", folder / "c_centers.pt"
    state = read_state(path, None)
    try:
        net = DinoV2.like(state)
    except KeyError as error:
        raise RivalError(f"{path}: missing {error.args[0]}") from error
    load_into(net, state, path)
    try:
        centres = torch.load(vocabulary, map_location="cpu", weights_only=True)
    except Exception as error:  # as above
        raise RivalError(f"{vocabulary}: {error}") from error
    channels = net.cls_token.shape[2]
    if not isinstance(centres, Tensor) or centres.ndim != 2 or centres.shape[1] != channels:
        raise RivalError(
            f"{vocabulary}: expected centres [K, {channels}], found {getattr(centres, 'shape', type(centres).__name__)}"
        )
    layer = min(ANYLOC_LAYER, len(net.blocks) - 1)

    def describe(image: Tensor) -> Tensor:
        # The centre, in whole patches.
        side = image.shape[-1] // PATCH_PX * PATCH_PX
        rim = (image.shape[-1] - side) // 2
        return vlad(net.values(normalise(image[..., rim : rim + side, rim : rim + side]), layer), centres.float())

    note = "" if layer == ANYLOC_LAYER else f"a smaller DINOv2, layer {layer} of {len(net.blocks)}"
    return Retrieval(name, describe, note=note)
