"""R2D2: keypoints where the network says that they repeat and that their descriptors are reliable.

Reference: Revaud et al., R2D2: Repeatable and Reliable Detector and Descriptor, NeurIPS 2019. The architecture is its
fully convolutional L2-Net with three 2 x 2 convolutions at the end, dilated instead of strided; names of parameters are
those of the released weights. As in the paper's comparison: both images at 256 px, one scale, thresholds 0.7, mutual
nearest neighbours, RANSAC.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from ..data.pair import Pair
from ..network.encoder import normalise
from .base import NO_WEIGHTS, Match, Rival, RivalError, Unready
from .classic import robust_homography
from .learned import inputs
from .retrieval import load_into

SIDE_PX = 256
THRESHOLD = 0.7
TOP = 5000

# Channels (of 32 width units: 4 each), kernel, stride that becomes dilation afterwards, whether a ReLU follows.
LAYERS = ((8, 3, 1, True), (8, 3, 1, True), (16, 3, 2, True), (16, 3, 1, True), (32, 3, 2, True), (32, 3, 1, True))
LAYERS += ((32, 2, 2, False), (32, 2, 2, False))


class R2d2(nn.Module):
    """`[B, 3, n, n]`, ImageNet-normalised -> descriptors `[B, D, n, n]` of unit length, reliability and repeatability
    `[B, 1, n, n]` in 0..1."""

    def __init__(self, width: int = 4, channels: int = 128) -> None:
        super().__init__()
        ops: list[nn.Module] = []
        before, dilation = 3, 1
        for units, kernel, stride, relu in LAYERS:
            pad = (kernel - 1) * dilation // 2
            ops += [nn.Conv2d(before, units * width, kernel, padding=pad, dilation=dilation)]
            ops += [nn.BatchNorm2d(units * width, affine=False), *([nn.ReLU()] if relu else [])]
            before, dilation = units * width, dilation * stride
        ops.append(nn.Conv2d(before, channels, 2, padding=dilation // 2, dilation=dilation))
        self.ops = nn.ModuleList(ops)
        self.clf = nn.Conv2d(channels, 2, 1)
        self.sal = nn.Conv2d(channels, 1, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = image
        for op in self.ops:
            x = op(x)
        reliability = torch.softmax(self.clf(x**2), 1)[:, 1:]
        raw = F.softplus(self.sal(x**2))
        return F.normalize(x, dim=1), reliability, raw / (1 + raw)


@torch.no_grad()
def keypoints(net: R2d2, image: Tensor, threshold: float = THRESHOLD) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """`[3, n, n]` in 0..1 -> x and y `[N, 2]`, descriptors `[N, D]`: local maxima of the repeatability above both
    thresholds, best 5000 by the product."""
    descriptors, reliability, repeatability = (out[0] for out in net(normalise(image[None])))
    peaks = (repeatability == F.max_pool2d(repeatability[None], 3, 1, 1)[0]) & (repeatability >= threshold)
    y, x = (peaks & (reliability >= threshold))[0].nonzero(as_tuple=True)
    order = (reliability * repeatability)[0, y, x].argsort(descending=True, stable=True)[:TOP]
    y, x = y[order], x[order]
    return torch.stack([x, y], 1).double().numpy(), descriptors[:, y, x].T.contiguous().numpy()


def mutual(a: NDArray[np.float32], b: NDArray[np.float32]) -> list[cv2.DMatch]:
    """Mutual nearest neighbours."""
    return list(cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a, b)) if len(a) and len(b) else []


def to_window(points: NDArray[np.float64], image_px: int, side_px: int = SIDE_PX) -> NDArray[np.float64]:
    """Pixels of the resized input -> of the image."""
    return (points + 0.5) * (image_px / side_px) - 0.5


@dataclass
class R2d2Rival:
    """R2D2 with a robust homography; its threshold is 5 px of the 256 px input, in window pixels here."""

    net: R2d2
    name: str = "R2D2 + RANSAC"
    window_m: int | None = None
    note: str = ""
    ready: bool = True
    threshold: float = THRESHOLD

    def match(self, pair: Pair) -> Match:
        """Both images resized to 256 px."""
        began = time.perf_counter()
        map_image, frame = inputs(pair, SIDE_PX)
        points, values = keypoints(self.net, frame, self.threshold)
        places, others = keypoints(self.net, map_image, self.threshold)
        pairs = mutual(values, others)
        source = to_window(points[[m.queryIdx for m in pairs]], pair.thermal.shape[0])
        target = to_window(places[[m.trainIdx for m in pairs]], pair.satellite.shape[0])
        found, detail = robust_homography(source, target, cv2.RANSAC, 5.0 * pair.satellite.shape[0] / SIDE_PX)
        return Match(found, time.perf_counter() - began, detail)


def load(path: Path | None) -> Rival:
    """`path`: released weights (`state_dict`), or a checkpoint of the paper's retraining (`netG`)."""
    if path is None:
        return Unready(R2d2Rival.name, NO_WEIGHTS)
    try:
        document = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for a file that is missing, cut or not a checkpoint
        raise RivalError(f"{path}: {error}") from error
    found = [document[key] for key in ("state_dict", "netG") if isinstance(document, dict) and key in document]
    if not found or not isinstance(found[0], dict):
        raise RivalError(f"{path}: expected a table of tensors under state_dict or netG")
    state = {str(key).removeprefix("module."): value for key, value in found[0].items()}
    net = R2d2()
    load_into(net, state, path)
    return R2d2Rival(net)
