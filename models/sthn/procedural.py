"""Images and weights made by formula, so that a parity case or a benchmark needs no file but numbers."""

from __future__ import annotations

import zlib

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .checkpoint import load_state
from .network import NetworkConfig, Sthn


def image(side: int) -> NDArray[np.uint8]:
    """A smooth RGB pattern, `[side, side, 3]`."""
    x, y = np.meshgrid(np.arange(side, dtype=np.float64), np.arange(side, dtype=np.float64))
    channels = [
        np.floor(
            127.5
            * (1 + np.sin(0.013 * (c + 1) * x + 3 * np.sin(0.007 * y)) * np.cos(0.017 * (c + 2) * y / 2 + 2 * np.sin(0.011 * x)))
        )
        for c in range(3)
    ]
    return np.stack(channels, axis=2).astype(np.uint8)


def thermal() -> NDArray[np.uint8]:
    """The frame of `image(1536)`: inverted gray of rows 400..912, columns 700..1212; `[512, 512]`."""
    return frame_of(image(1536))


def blocks(side: int, block: int = 12) -> NDArray[np.uint8]:
    """The pattern of `image` in blocks: edges to match, and small once deflated. For golden pairs."""
    small = image(-(-side // block) * 5)[::5, ::5]
    return np.repeat(np.repeat(small, block, axis=0), block, axis=1)[:side, :side].copy()


def frame_of(window: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The inverted gray of a 512 x 512 part of a window of at least that size (rows 400.., columns 700.. of 1536)."""
    spare = window.shape[0] - 512
    top, left = spare * 400 // 1024, spare * 700 // 1024
    cut = window[top : top + 512, left : left + 512].astype(np.float64)
    return np.floor(255 - cut.mean(2)).astype(np.uint8)


def weights(network: Sthn, seed: int = 0) -> dict[str, Tensor]:
    """Every weight of `network` from its key (seed 0 is the parity case; another seed, other weights)."""
    state = {}
    for key, value in network.state_dict().items():
        shape = tuple(value.shape)
        if value.ndim == 4:
            generator = np.random.default_rng(zlib.crc32(key.encode()) + seed)
            drawn = generator.standard_normal(shape) * np.sqrt(2 / (shape[0] * shape[2] * shape[3]))
            if key.endswith(".layer10.3.weight"):
                drawn *= 0.8 if key.startswith("netG.") else 0.6
        else:
            drawn = np.ones(shape) if key.endswith(".weight") else np.zeros(shape)
        state[key] = torch.from_numpy(drawn.astype(np.float32))
    return state


def network(config: NetworkConfig, seed: int = 0) -> Sthn:
    """The published architecture with procedural weights, in evaluation mode."""
    built = Sthn(config)
    load_state(built, weights(built, seed), "procedural weights")
    return built.eval()


PARITY_1536 = NetworkConfig(
    resize_width=256, database_size=1536, corr_level=4, iters_lev0=6, iters_lev1=6, fine_padding=32, two_stages=True
)
"""Configuration of the committed parity case."""
