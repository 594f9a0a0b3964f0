"""Augmentation of the box B in two-stage training. Paper Sec. III-C; defaults are the public code's.

Its centre moves by U(-64, 64) per axis and its width grows by U[0, 64) in all, window pixels (the paper's text: by
2 Delta p3 with Delta p3 in [0, 64), `rule = "paper"`). Without it the refinement barely moves; with widening alone it only
shrinks towards the centre: `kind = "none"` and `kind = "widen"` are those ablations.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from ..network import Box, NetworkConfig, bounding_box
from .experiment import BoxTable


def draw(table: BoxTable, batch: int, generator: torch.Generator) -> Tensor:
    """`[B, 3]`: what is added to x and y of the centre and to the width, window px. The same numbers are drawn for every
    kind, so that ablations differ in nothing else."""
    unit = torch.rand(batch, 3, generator=generator, dtype=torch.float64)
    move = (2 * unit[:, :2] - 1) * table.centre_px if table.kind == "full" else torch.zeros(batch, 2, dtype=torch.float64)
    widen = unit[:, 2:] * table.widen_px * (2 if table.rule == "paper" else 1)
    return torch.cat([move, widen if table.kind != "none" else torch.zeros_like(widen)], 1)


def augmented(displacement: Tensor, config: NetworkConfig, drawn: Tensor) -> Box:
    """The box of a coarse displacement without evaluation's padding, moved and widened."""
    tight = bounding_box(displacement, dataclasses.replace(config, fine_padding=0))
    dx, dy, wider = drawn.to(tight.left).unbind(1)
    return Box(tight.left + dx - wider / 2, tight.top + dy - wider / 2, tight.width + wider)
