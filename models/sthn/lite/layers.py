"""Building blocks of the light networks."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def norm(kind: str, channels: int) -> nn.Module:
    """`batch` for the map (in evaluation no statistics over the window: features belong to the map), `group` else."""
    return nn.BatchNorm2d(channels) if kind == "batch" else nn.GroupNorm(4, channels)


class Block(nn.Module):
    """Two 3 x 3 convolutions with a residual connection."""

    def __init__(self, channels_in: int, channels: int, stride: int, kind: str):
        super().__init__()
        self.first = nn.Conv2d(channels_in, channels, 3, stride, 1, bias=False)
        self.norm1 = norm(kind, channels)
        self.second = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.norm2 = norm(kind, channels)
        same = stride == 1 and channels_in == channels
        self.skip = nn.Identity() if same else nn.Conv2d(channels_in, channels, 1, stride, 0, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.norm1(self.first(x)))
        return torch.relu(self.norm2(self.second(y)) + self.skip(x))


class Encoder(nn.Module):
    """U-shape: features at half the input's resolution, additive skips, bilinear up-sampling."""

    def __init__(self, channels_in: int, widths: tuple[int, ...], channels_out: int, kind: str):
        super().__init__()
        self.stem = nn.Conv2d(channels_in, widths[0], 3, 2, 1, bias=False)
        self.stem_norm = norm(kind, widths[0])
        downs = [Block(widths[0], widths[0], 1, kind)]
        downs += [Block(a, b, 2, kind) for a, b in zip(widths, widths[1:], strict=False)]
        self.downs = nn.ModuleList(downs)
        self.laterals = nn.ModuleList([nn.Conv2d(b, a, 1, bias=False) for a, b in zip(widths, widths[1:], strict=False)])
        self.ups = nn.ModuleList([Block(a, a, 1, kind) for a in widths[:-1]])
        self.out = nn.Conv2d(widths[0], channels_out, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.stem_norm(self.stem(x)))
        kept = []
        for down in self.downs:
            x = down(x)
            kept.append(x)
        for level in range(len(self.ups) - 1, -1, -1):
            up = nn.functional.interpolate(self.laterals[level](x), scale_factor=2.0, mode="bilinear", align_corners=False)
            x = self.ups[level](kept[level] + up)
        return self.out(x)


def normalise(features: Tensor) -> Tensor:
    """Unit length per cell."""
    return features * torch.rsqrt((features * features).sum(1, keepdim=True) + 1e-6)


def standardise_frame(frame: Tensor) -> Tensor:
    """Gray and mask `[B, 2, n, n]` -> gray with zero mean and unit variance over what was seen, 0 elsewhere; mask."""
    gray, mask = frame[:, :1], frame[:, 1:]
    count = mask.sum((2, 3), keepdim=True) + 1.0
    mean = (gray * mask).sum((2, 3), keepdim=True) / count
    centred = (gray - mean) * mask
    variance = (centred * centred).sum((2, 3), keepdim=True) / count
    return torch.cat([centred * torch.rsqrt(variance + 1e-4), mask], 1)
