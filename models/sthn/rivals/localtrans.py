"""LocalTrans: a cascade of local transformers, from coarse features to fine ones.

At each scale the map's features are warped by the homography so far; frame and map attend to themselves and then the
frame to the map, each cell to the 9 x 9 cells about it only; a small network reads the attention as a correlation and
gives the remaining homography. What is compact here: three scales, one attention layer of each kind, one head.

Reference: Shao et al., LocalTrans: A Multiscale Local Transformer Network for Cross-Resolution Homography Estimation,
ICCV 2021, Sec. 3.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..network.homography import identity_grid, square_to_quad, transform_grid

RADIUS = 4
STRIDES = (16, 8, 4)
"""Input pixels a cell, coarse to fine."""


def local_attention(query: Tensor, key: Tensor, value: Tensor, radius: int = RADIUS) -> tuple[Tensor, Tensor]:
    """Each cell of `query` `[B, C, h, w]` attends to the cells within `radius` of its own place in `key`: attended values
    `[B, C, h, w]`, attention `[B, (2 r + 1)^2, h, w]` (sums to 1; 0 outside the map)."""
    b, c, h, w = query.shape
    size = 2 * radius + 1
    keys = F.unfold(key, size, padding=radius).view(b, c, size * size, h * w)
    values = F.unfold(value, size, padding=radius).view(b, c, size * size, h * w)
    inside = F.unfold(query.new_ones(1, 1, h, w), size, padding=radius)
    score = (query.flatten(2)[:, :, None] * keys).sum(1) / c**0.5
    attention = torch.softmax(score.masked_fill(inside == 0, -torch.inf), 1)
    attended = (values * attention[:, None]).sum(2)
    return attended.view(b, c, h, w), attention.view(b, size * size, h, w)


class AttentionLayer(nn.Module):
    """Local attention with a residual, then a 1 x 1 network with another."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.query, self.key, self.value, self.out = (nn.Conv2d(channels, channels, 1, bias=False) for _ in range(4))
        self.norm1, self.norm2 = nn.GroupNorm(1, channels), nn.GroupNorm(1, channels)
        self.feed = nn.Sequential(nn.Conv2d(channels, 2 * channels, 1), nn.ReLU(), nn.Conv2d(2 * channels, channels, 1))

    def forward(self, x: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        attended, attention = local_attention(self.query(x), self.key(other), self.value(other))
        x = self.norm1(x + self.out(attended))
        return self.norm2(x + self.feed(x)), attention


class Scale(nn.Module):
    """One scale: self-attention of both, cross-attention, what is left of the homography."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.own, self.cross = AttentionLayer(channels), AttentionLayer(channels)
        cells = (2 * RADIUS + 1) ** 2
        self.head = nn.Sequential(
            nn.Conv2d(cells + channels, 128, 3, padding=1),
            nn.GroupNorm(8, 128),
            nn.ReLU(),
            nn.Conv2d(128, 128, 3, 2, 1),
            nn.GroupNorm(8, 128),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(2),
            nn.Flatten(),
            nn.Linear(4 * 128, 8),
        )
        nn.init.zeros_(self.head[-1].weight)
        nn.init.zeros_(self.head[-1].bias)

    def forward(self, map_features: Tensor, frame_features: Tensor) -> Tensor:
        map_features, _ = self.own(map_features, map_features)
        frame_features, _ = self.own(frame_features, frame_features)
        attended, attention = self.cross(frame_features, map_features)
        cells = attention.shape[1]
        return self.head(torch.cat([attention * cells, attended], 1)).unflatten(1, (2, 2, 2))


class LocalTrans(nn.Module):
    """Map and frame `[B, 3, n, n]` in 0..1 -> cumulative displacements `[3, B, 2, 2, 2]`, pixels of the input."""

    def __init__(self, side_px: int = 128, channels: int = 64) -> None:
        super().__init__()
        self.side_px = side_px

        def block(before: int, stride: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Conv2d(before, channels, 3, stride, 1),
                nn.GroupNorm(8, channels),
                nn.ReLU(),
                nn.Conv2d(channels, channels, 3, 1, 1),
                nn.GroupNorm(8, channels),
                nn.ReLU(),
            )

        self.stem = nn.Sequential(nn.Conv2d(3, channels, 7, 2, 3), nn.GroupNorm(8, channels), nn.ReLU())
        self.downs = nn.ModuleList([block(channels, 2) for _ in STRIDES])
        self.scales = nn.ModuleList([Scale(channels) for _ in STRIDES])

    def pyramid(self, image: Tensor) -> list[Tensor]:
        """Features at every stride of STRIDES, coarse first."""
        x = self.stem((image - 0.45) * 4)
        found = []
        for down in self.downs:
            x = down(x)
            found.append(x)
        return found[::-1]

    def forward(self, map_image: Tensor, frame: Tensor) -> Tensor:
        maps, frames = self.pyramid(map_image), self.pyramid(frame)
        last = self.side_px - 1.0
        corners = frame.new_tensor([[[0.0, last], [0.0, last]], [[0.0, 0.0], [last, last]]])[None]
        displacement = torch.zeros_like(corners).expand(len(frame), -1, -1, -1)
        cumulative = []
        for map_features, frame_features, scale, stride in zip(maps, frames, self.scales, STRIDES, strict=True):
            matrix = square_to_quad(corners + displacement, last)
            left = scale(warp(map_features, matrix, stride), frame_features) * stride
            # What is left lies in the warped map: H_{k+1} = H_k o delta H.
            displacement = transform_grid(matrix, corners + left) - corners
            cumulative.append(displacement)
        return torch.stack(cumulative)


def warp(features: Tensor, matrix: Tensor, stride: int) -> Tensor:
    """The map's features where the frame's cells lie: cell i is at input pixel stride i + (stride - 1) / 2."""
    h, w = features.shape[-2:]
    half = (stride - 1) / 2
    at = transform_grid(matrix, identity_grid(h, features) * stride + half)
    at = (at - half) / stride
    grid = torch.stack([2 * at[:, 0] / (w - 1) - 1, 2 * at[:, 1] / (h - 1) - 1], -1)
    return F.grid_sample(features, grid, align_corners=True, padding_mode="zeros")
