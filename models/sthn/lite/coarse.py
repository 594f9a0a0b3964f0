"""The light coarse stage: two encoders whose features correlate. Search and posterior are outside (`sthn.correlate`)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .layers import Encoder, normalise, standardise_frame


class CoarseNet(nn.Module):
    """Map `[B, 3, h, w]` in 0..1 and frame `[B, 2, n, n]` (gray, mask) -> features at half resolution.

    The frame's features are weighted so that their plain cross-correlation with the map's is a logit: the mean cosine
    over the cells that were seen, times a learned factor.
    """

    def __init__(self, widths: tuple[int, ...] = (24, 48, 72, 96), channels: int = 32):
        super().__init__()
        self.map_encoder = Encoder(3, widths, channels, "batch")
        self.frame_encoder = Encoder(2, widths, channels, "group")
        self.log_factor = nn.Parameter(torch.tensor(4.0))

    def encode_map(self, image: Tensor) -> Tensor:
        return normalise(self.map_encoder((image - 0.45) * 4.0))

    def encode_frame(self, frame: Tensor) -> Tensor:
        frame = standardise_frame(frame)
        features = normalise(self.frame_encoder(frame))
        seen = nn.functional.avg_pool2d(frame[:, 1:], 2)
        return features * seen * (torch.exp(self.log_factor) / (seen.sum((2, 3), keepdim=True) + 1.0))


class MapSide(nn.Module):
    """`map` -> `map_features`, for export."""

    def __init__(self, net: CoarseNet):
        super().__init__()
        self.net = net

    def forward(self, map: Tensor) -> Tensor:  # noqa: A002 (the graph's input name)
        return self.net.encode_map(map)


class FrameSide(nn.Module):
    """`frame` -> `frame_features`, for export."""

    def __init__(self, net: CoarseNet):
        super().__init__()
        self.net = net

    def forward(self, frame: Tensor) -> Tensor:
        return self.net.encode_frame(frame)


def correlate_all(map_features: Tensor, frame_features: Tensor) -> Tensor:
    """Every frame against every map: `[Bm, C, H, W]`, `[Bf, C, h, w]` -> `[Bf, Bm, H - h + 1, W - w + 1]`."""
    h, w = map_features.shape[-2:]
    fm = torch.fft.rfft2(map_features.float())
    ff = torch.fft.rfft2(frame_features.float(), s=(h, w))
    product = torch.einsum("bchw,dchw->bdhw", ff.conj(), fm)
    surface = torch.fft.irfft2(product, s=(h, w))
    return surface[..., : h - frame_features.shape[-2] + 1, : w - frame_features.shape[-1] + 1]


def loss_of(surfaces: Tensor, shift_cells: Tensor) -> Tensor:
    """Cross-entropy over all places of all maps, target spread bilinearly over four cells. `shift_cells` `[B, 2]` x, y."""
    b, _, h, w = surfaces.shape
    log_p = torch.log_softmax(surfaces.reshape(b, -1), 1).reshape(surfaces.shape)
    own = log_p[torch.arange(b), torch.arange(b)]
    x0, y0 = shift_cells[:, 0].floor(), shift_cells[:, 1].floor()
    loss = torch.zeros(b)
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = x0 + dx, y0 + dy
            weight = (1 - (shift_cells[:, 0] - x).abs()) * (1 - (shift_cells[:, 1] - y).abs())
            xi, yi = x.long().clamp(0, w - 1), y.long().clamp(0, h - 1)
            loss = loss - weight * own[torch.arange(b), yi, xi]
    return loss
