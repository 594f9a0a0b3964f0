"""The learned homography networks as rivals: DHN, IHN, LocalTrans, with weights of `sthn.rivals.train`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from .. import geometry
from ..data.pair import Pair
from ..network import Lookup, Matcher, resize_thermal
from .base import NO_WEIGHTS, Match, Rival, RivalError, Unready, check_window
from .dhn import Dhn
from .localtrans import LocalTrans

PAPER_STEPS = 200_000
"""Shorter trainings are marked as short runs."""


def ihn(side_px: int) -> Matcher:
    """IHN: our coarse network with the look-up that IHN has, indexed by the image that H starts from, at H(p) in the
    other; 2 levels, 6 iterations.

    Reference: Cao et al., Iterative Deep Homography Estimation, CVPR 2022.
    """
    return Matcher(side_px, 2, 6, Lookup.FRAME_INDEXED)


NETWORKS: dict[str, tuple[str, Callable[[int], nn.Module]]] = {
    "dhn": ("DHN", Dhn),
    "localtrans": ("LocalTrans", LocalTrans),
    "ihn": ("IHN", ihn),
}
"""Key -> printed name, network for inputs of a number of pixels."""


def inputs(pair: Pair, side_px: int) -> tuple[Tensor, Tensor]:
    """Map and frame `[3, n, n]` in 0..1, resized with antialias."""
    satellite = torch.from_numpy(np.ascontiguousarray(np.moveaxis(pair.satellite, -1, 0)))[None].float() / 255
    thermal = torch.from_numpy(np.ascontiguousarray(pair.thermal))[None, None].float() / 255
    return resize_thermal(satellite, side_px)[0], resize_thermal(thermal, side_px)[0].expand(3, -1, -1)


@dataclass
class Learned:
    """A trained network; its window is the one it was trained for."""

    name: str
    net: nn.Module
    side_px: int
    window_m: int | None
    note: str
    ready: bool = True

    @torch.no_grad()
    def match(self, pair: Pair) -> Match:
        """Last iteration's displacement -> homography."""
        check_window(self, pair)
        began = time.perf_counter()
        map_image, frame = inputs(pair, self.side_px)
        displacement = self.net(map_image[None], frame[None])[-1, 0].double().numpy()
        try:
            found = geometry.homography_of_displacement(
                pair.thermal.shape[0], self.side_px, displacement, pair.window_m / self.side_px
            )
        except ValueError as error:
            return Match(None, time.perf_counter() - began, {"failure": str(error)})
        return Match(found, time.perf_counter() - began)


def load(key: str, folder: Path | None) -> Rival:
    """The rival with the weights that a training left in `folder` (`weights.pt`, `training.json`)."""
    label, build = NETWORKS[key]
    if folder is None:
        return Unready(label, NO_WEIGHTS)
    facts = read_facts(folder)
    if facts["rival"] != key:
        raise RivalError(f"{folder / 'training.json'}: rival: expected {key}, found {facts['rival']}")
    net = build(facts["side_px"])
    try:
        net.load_state_dict(torch.load(folder / "weights.pt", map_location="cpu", weights_only=True))
    except Exception as error:  # torch raises many types for a file that is missing, cut or not these weights
        raise RivalError(f"{folder / 'weights.pt'}: {error}") from error
    steps = facts["steps"]
    note = f"short run, {steps} steps" if steps < PAPER_STEPS else ""
    return Learned(label, net.eval(), facts["side_px"], facts["window_m"], note)


def read_facts(folder: Path) -> dict:
    """`training.json`, with the fields that a rival needs."""
    path = folder / "training.json"
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RivalError(f"{path}: {error}") from error
    for key, kind in (("rival", str), ("side_px", int), ("window_m", int), ("steps", int)):
        if not isinstance(facts, dict) or type(facts.get(key)) is not kind:
            raise RivalError(
                f"{path}: {key}: expected {kind.__name__}, found {facts.get(key) if isinstance(facts, dict) else facts!r}"
            )
    return facts
