"""The update block: correlation and flow in, an increment of the four corners' displacement out."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .correlation import WINDOW

WIDTH = 128
GROUPS = 16


class UpdateNetwork(nn.Module):
    """Convolutions with GroupNorm, ReLU and 2x2 max-pooling until 2 x 2 cells are left: one per corner.

    Attribute names are the released keys: `layer1` .. `layerN` for N poolings (5 for W_R = 256) and `layer10`, the head.
    """

    def __init__(self, levels: int, feature_side: int) -> None:
        super().__init__()
        self.poolings = feature_side.bit_length() - 2
        channels = WINDOW**2 * levels + 2
        for i in range(self.poolings):
            self.add_module(
                f"layer{i + 1}",
                nn.Sequential(nn.Conv2d(channels if i == 0 else WIDTH, WIDTH, 3, padding=1), nn.GroupNorm(GROUPS, WIDTH)),
            )
        self.layer10 = nn.Sequential(
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1), nn.GroupNorm(GROUPS, WIDTH), nn.ReLU(), nn.Conv2d(WIDTH, 2, 1)
        )

    def forward(self, x: Tensor) -> Tensor:
        for i in range(self.poolings):
            x = F.max_pool2d(torch.relu(self.get_submodule(f"layer{i + 1}")(x)), 2)
        return self.layer10(x)


class UpdateBlock(nn.Module):
    """`[B, 81 L, H, W]` and `[B, 2, H, W]` -> `[B, 2, 2, 2]`: x|y, top|bottom, left|right, pixels of the stage's input.
    Nothing scales or bounds it."""

    def __init__(self, levels: int, feature_side: int) -> None:
        super().__init__()
        self.cnn = UpdateNetwork(levels, feature_side)

    def forward(self, correlation: Tensor, flow: Tensor) -> Tensor:
        return self.cnn(torch.cat([correlation, flow], dim=1))
