"""The whole published network: coarse, crop, fine, combine. Paper Sec. III-C.

Corners are inclusive pixels: the box of network pixels left .. right covers left * alpha .. (right + 1) * alpha of the
window.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor, nn

from .config import NetworkConfig
from .correlation import Lookup
from .matcher import Matcher
from .resize import resize_satellite, resize_thermal

FINE_LEVELS = 2
"""Correlation levels of the fine network, whatever the configuration says of the coarse one."""


@dataclasses.dataclass(frozen=True)
class Box:
    """The square B of the window that the fine stage sees, window pixels, in double precision: single precision moves
    the crop by 1e-4 px, which the fine stage amplifies."""

    left: Tensor
    """x of its first sample, `[B]`."""
    top: Tensor
    """y of its first sample, `[B]`."""
    width: Tensor
    """W_B, padding included, `[B]`."""

    def flow(self, window_side: int) -> Tensor:
        """D_S->B: displacement of the window's inclusive corners onto the box's, window pixels, `[B, 2, 2, 2]`."""
        far = self.width - window_side
        x = torch.stack([self.left, self.left + far], 1)[:, None, :].expand(-1, 2, -1)
        y = torch.stack([self.top, self.top + far], 1)[:, :, None].expand(-1, -1, 2)
        return torch.stack([x, y], 1)


def bounding_box(displacement: Tensor, config: NetworkConfig) -> Box:
    """The axis-aligned square round the displaced corners, padded. Paper Eq. (4)."""
    # A left corner at 0 becomes 0; a right one at W_R - 1 becomes W_S: the box covers its last pixel.
    corner = torch.tensor([0.0, config.resize_width], dtype=torch.float64, device=displacement.device)
    x = ((displacement[:, 0].double() + corner[None, None, :]) * config.alpha).flatten(1)
    y = ((displacement[:, 1].double() + corner[None, :, None]) * config.alpha).flatten(1)
    left, end, top, bottom = x.amin(1), x.amax(1), y.amin(1), y.amax(1)
    width = torch.maximum(end - left, bottom - top) + 2 * config.fine_padding
    return Box((left + end) / 2 - width / 2, (top + bottom) / 2 - width / 2, width)


def crop(window: Tensor, box: Box, size_out: int) -> Tensor:
    """`[B, C, W_S, W_S]` -> `[B, C, size_out, size_out]`: sample i at x_s + i (W_B - 1) / (size_out - 1), bilinear, zero
    outside, no antialias."""
    steps = torch.arange(size_out, dtype=box.left.dtype, device=window.device) / (size_out - 1)
    x = box.left[:, None] + steps * (box.width[:, None] - 1)
    y = box.top[:, None] + steps * (box.width[:, None] - 1)
    height, width = window.shape[-2:]
    batch = torch.arange(window.shape[0], device=window.device)[:, None, None]
    pixels = window.permute(0, 2, 3, 1)
    x0, y0 = torch.floor(x), torch.floor(y)
    out = torch.zeros((), dtype=window.dtype, device=window.device)
    for yi, wy in ((y0, 1 - (y - y0)), (y0 + 1, y - y0)):
        for xi, wx in ((x0, 1 - (x - x0)), (x0 + 1, x - x0)):
            wx = wx * ((xi >= 0) & (xi < width))
            wy_in = wy * ((yi >= 0) & (yi < height))
            taps = pixels[batch, yi.long().clamp(0, height - 1)[:, :, None], xi.long().clamp(0, width - 1)[:, None, :]]
            out = out + taps * (wy_in[:, :, None] * wx[:, None, :])[..., None].to(window.dtype)
    return out.permute(0, 3, 1, 2)


def combine(fine: Tensor, box: Box, config: NetworkConfig) -> Tensor:
    """D_S->T = D_S->B + D_B->T on the scale of the coarse input. Paper Eq. (7): kappa = eta / alpha, eta = W_B / W_R."""
    kappa = box.width / config.resize_width / config.alpha
    return (fine * kappa[:, None, None, None] + box.flow(config.database_size) / config.alpha).to(fine.dtype)


@dataclasses.dataclass(frozen=True)
class Match:
    """Everything a forward pass gives. Displacements are `[x|y, top|bottom, left|right]`."""

    satellite: Tensor
    """Coarse map input, `[B, 3, W_R, W_R]`, 0..1."""
    thermal: Tensor
    """Frame input, `[B, 3, W_R, W_R]`, 0..1."""
    coarse_iterations: Tensor
    """`[K_1, B, 2, 2, 2]`, pixels of the coarse input."""
    box: Box | None
    """What the fine stage sees."""
    crop: Tensor | None
    """Fine map input, `[B, 3, W_R, W_R]`, 0..1."""
    fine_iterations: Tensor | None
    """`[K_2, B, 2, 2, 2]`, pixels of the crop."""
    final: Tensor
    """D_S->T, `[B, 2, 2, 2]`, pixels of the coarse input."""


class Sthn(nn.Module):
    """The published network. Attribute names are the released key prefixes."""

    def __init__(self, config: NetworkConfig, lookup: Lookup = Lookup.PUBLISHED) -> None:
        super().__init__()
        self.config = config
        self.netG = Matcher(config.resize_width, config.corr_level, config.iters_lev0, lookup)
        self.netG_fine = Matcher(config.resize_width, FINE_LEVELS, config.iters_lev1, lookup) if config.two_stages else None

    def forward(self, window: Tensor, thermal: Tensor, box_of: Callable[[Tensor], Box] | None = None) -> Match:
        """`window`: `[B, 3, W_S, W_S]` in 0..1; `thermal`: `[B, 3, H, H]` in 0..1, covering the frame's square.

        `box_of`: coarse displacement -> box B, where it is not `bounding_box`: training moves and widens it.
        """
        side = self.config.resize_width
        satellite, thermal = resize_satellite(window, side), resize_thermal(thermal, side)
        coarse = self.netG(satellite, thermal)
        if self.netG_fine is None:
            return Match(satellite, thermal, coarse, None, None, None, coarse[-1])
        # The box is not differentiated: each stage learns from its own loss.
        last = coarse[-1].detach()
        box = bounding_box(last, self.config) if box_of is None else box_of(last)
        cut = crop(window, box, side)
        fine = self.netG_fine(cut, thermal)
        return Match(satellite, thermal, coarse, box, cut, fine, combine(fine[-1], box, self.config))
