"""How the published network's inputs are resized.

The satellite window by torch's `align_corners=True` **with** `antialias=True`, whose samples lie at s (i + 0.5) with
s = (n - 1) / (m - 1): neither corner- nor centre-aligned, but the weights were trained with it, and a plain resize
moves positions by metres. The thermal frame by half-pixel antialias.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F


def published_weights(size_in: int, size_out: int) -> NDArray[np.float64]:
    """`[size_out, size_in]`: the 1-D weights of the published satellite resize, separable in x and y."""
    scale = (size_in - 1) / (size_out - 1)
    return _triangle(size_in, scale * (np.arange(size_out) + 0.5), scale)


def half_pixel_weights(size_in: int, size_out: int) -> NDArray[np.float64]:
    """`[size_out, size_in]`: the 1-D weights of bilinear half-pixel antialias resizing (`align_corners=False`)."""
    scale = size_in / size_out
    return _triangle(size_in, scale * (np.arange(size_out) + 0.5), scale)


def _triangle(size_in: int, centres: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Triangle filter about `centres` (pixel j spans j .. j + 1), clipped to the image and renormalised."""
    support = max(scale, 1.0)
    taps = np.arange(size_in)
    first = np.clip(np.floor(centres - support + 0.5), 0, None)
    last = np.clip(np.floor(centres + support + 0.5), None, size_in)
    weights = np.clip(1 - np.abs(taps + 0.5 - centres[:, None]) / support, 0, None)
    weights[(taps < first[:, None]) | (taps >= last[:, None])] = 0
    return weights / weights.sum(1, keepdims=True)


def resize(image: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """`[C, H, W]` by the same 1-D weights along both axes."""
    return np.einsum("yh,chw,xw->cyx", weights, image, weights, optimize=True)


def resize_satellite(image: Tensor, size_out: int) -> Tensor:
    """torch's own: `[B, 3, W_S, W_S]` -> `[B, 3, size_out, size_out]` by the published rule."""
    return F.interpolate(image, size=(size_out, size_out), mode="bilinear", align_corners=True, antialias=True)


def resize_thermal(image: Tensor, size_out: int) -> Tensor:
    """torch's own: `[B, C, H, W]` -> `[B, C, size_out, size_out]`, half-pixel, antialias."""
    if image.shape[-1] == size_out and image.shape[-2] == size_out:
        return image
    return F.interpolate(image, size=(size_out, size_out), mode="bilinear", align_corners=False, antialias=True)
