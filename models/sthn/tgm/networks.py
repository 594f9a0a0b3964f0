"""The two networks of the TGM: a U-Net that paints thermal, a 70 x 70 PatchGAN that judges it.

Both are the published ones at their defaults: 8 halvings and 64 channels for 512 px. Attribute names are the keys of the
released checkpoints. Images are in -1..1.

Reference: Isola et al., Image-to-Image Translation with Conditional Adversarial Networks, CVPR 2017, Sec. 6.1; the
up-sampling is bilinear with a 5 x 5 convolution, as in Xiao et al., STHN, RA-L 2024.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

DOWNS, NGF, NDF = 8, 64, 64
SATELLITE_CHANNELS, THERMAL_CHANNELS = 3, 1


def _up(channels_in: int, channels_out: int, bias: bool) -> nn.Sequential:
    """x 2 by `align_corners=True` bilinear, then 5 x 5."""
    return nn.Sequential(nn.UpsamplingBilinear2d(scale_factor=2), nn.Conv2d(channels_in, channels_out, 5, padding=2, bias=bias))


class SkipBlock(nn.Module):
    """One level of the U: halves, goes deeper, doubles; its input is laid beside its output.

    In `model` stand, in order: activation, 4 x 4 convolution of stride 2 and norm on the way down (no norm at the
    deepest level); the level below; activation, up-sampling and norm on the way up.
    """

    def __init__(self, outer: int, inner: int, below: SkipBlock | None) -> None:
        super().__init__()
        down: list[nn.Module] = [nn.LeakyReLU(0.2), nn.Conv2d(outer, inner, 4, 2, 1, bias=False)]
        if below is not None:
            down += [nn.BatchNorm2d(inner), below]
        up = [nn.ReLU(), _up(inner if below is None else 2 * inner, outer, bias=False), nn.BatchNorm2d(outer)]
        self.model = nn.Sequential(*down, *up)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.model(x)], 1)


class Outermost(nn.Module):
    """The first halving and the last doubling: neither norm nor skip."""

    def __init__(self, ngf: int, below: SkipBlock, tanh: bool) -> None:
        super().__init__()
        first = nn.Conv2d(SATELLITE_CHANNELS, ngf, 4, 2, 1, bias=False)
        last = [nn.Tanh()] if tanh else []
        self.model = nn.Sequential(first, below, nn.ReLU(), _up(2 * ngf, THERMAL_CHANNELS, bias=True), *last)

    def forward(self, x: Tensor) -> Tensor:
        return self.model(x)


class Generator(nn.Module):
    """Satellite `[B, 3, n, n]` -> thermal `[B, 1, n, n]`, n a multiple of 2^downs. Without tanh (the published default)
    the output is not bounded: generation clamps it. Weights start as PyTorch draws them, as in the public code."""

    def __init__(self, downs: int = DOWNS, ngf: int = NGF, tanh: bool = False) -> None:
        super().__init__()
        if downs < 5:
            raise ValueError(f"generator: downs: expected at least 5, found {downs}")
        if ngf < 1:
            raise ValueError(f"generator: ngf: expected at least 1, found {ngf}")
        self.downs, self.ngf = downs, ngf
        block = None
        for _ in range(downs - 4):
            block = SkipBlock(8 * ngf, 8 * ngf, block)
        for factor in (4, 2, 1):
            block = SkipBlock(factor * ngf, 2 * factor * ngf, block)
        self.model = Outermost(ngf, block, tanh)

    def forward(self, satellite: Tensor) -> Tensor:
        return self.model(satellite)


class Discriminator(nn.Module):
    """Satellite and thermal `[B, 4, n, n]` -> a judgement of every 70 x 70 patch, `[B, 1, n/8 - 2, n/8 - 2]`: near 1 for
    real, near 0 for generated (least squares, no sigmoid)."""

    def __init__(self, ndf: int = NDF) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(SATELLITE_CHANNELS + THERMAL_CHANNELS, ndf, 4, 2, 1), nn.LeakyReLU(0.2)]
        for before, after, stride in ((1, 2, 2), (2, 4, 2), (4, 8, 1)):
            layers += [nn.Conv2d(before * ndf, after * ndf, 4, stride, 1, bias=False), nn.BatchNorm2d(after * ndf)]
            layers += [nn.LeakyReLU(0.2)]
        self.model = nn.Sequential(*layers, nn.Conv2d(8 * ndf, 1, 4, 1, 1))

    def forward(self, satellite: Tensor, thermal: Tensor) -> Tensor:
        return self.model(torch.cat([satellite, thermal], 1))
