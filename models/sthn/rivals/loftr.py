"""LoFTR by kornia (an optional package: `pip install kornia==0.9.0`), with RANSAC.

Reference: Sun et al., LoFTR: Detector-Free Local Feature Matching with Transformers, CVPR 2021. As in the paper's
comparison: both images gray at 256 px, RANSAC.
"""

from __future__ import annotations

import importlib.util
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
from torch import nn

from ..data.pair import Pair
from .base import NO_WEIGHTS, Match, Rival, Unready
from .classic import robust_homography
from .learned import inputs
from .r2d2 import SIDE_PX, to_window
from .retrieval import load_into, read_state

NAME = "LoFTR + RANSAC"


def installed() -> bool:
    """Whether kornia is there."""
    return importlib.util.find_spec("kornia") is not None


def network() -> nn.Module:
    """The outdoor architecture, untrained."""
    from kornia.feature import LoFTR

    return LoFTR(pretrained=None).eval()


@dataclass
class Loftr:
    """Dense matches of two gray images with a robust homography."""

    net: nn.Module
    name: str = NAME
    window_m: int | None = None
    note: str = ""
    ready: bool = True
    side_px: int = SIDE_PX

    @torch.no_grad()
    def match(self, pair: Pair) -> Match:
        """Both images resized to `side_px`."""
        began = time.perf_counter()
        map_image, frame = inputs(pair, self.side_px)
        red, green, blue = map_image
        gray = 0.299 * red + 0.587 * green + 0.114 * blue
        out = self.net({"image0": frame[None, :1], "image1": gray[None, None]})
        source, target = (out[key].double().numpy() for key in ("keypoints0", "keypoints1"))
        source = to_window(source, pair.thermal.shape[0], self.side_px)
        target = to_window(target, pair.satellite.shape[0], self.side_px)
        found, detail = robust_homography(source, target, cv2.RANSAC, 5.0 * pair.satellite.shape[0] / self.side_px)
        return Match(found, time.perf_counter() - began, detail)


def load(path: Path | None) -> Rival:
    """`path`: released weights (`loftr_outdoor.ckpt`: `state_dict`)."""
    if not installed():
        return Unready(NAME, "kornia is not installed here")
    if path is None:
        return Unready(NAME, NO_WEIGHTS)
    net = network()
    state = {key.removeprefix("matcher."): value for key, value in read_state(path, "state_dict").items()}
    load_into(net, state, path)
    return Loftr(net)
