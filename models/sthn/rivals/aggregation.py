"""From a feature map to one vector: GeM, NetVLAD, VLAD with a given vocabulary. All of unit length."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class L2Norm(nn.Module):
    """Unit length along the channels."""

    def forward(self, x: Tensor) -> Tensor:
        return F.normalize(x, dim=1)


class GeM(nn.Module):
    """Generalised mean over the cells, `[B, C, h, w]` -> `[B, C]`.

    Reference: Radenovic, Tolias, Chum, Fine-tuning CNN Image Retrieval with No Human Annotation, TPAMI 2019, Eq. (3).
    """

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))

    def forward(self, x: Tensor) -> Tensor:
        return x.clamp(min=1e-6).pow(self.p).mean((2, 3)).pow(1 / self.p)


class NetVlad(nn.Module):
    """Softly assigned residuals to K learned centres, `[B, C, h, w]` -> `[B, K C]`; normalised per centre, then whole.

    Reference: Arandjelovic et al., NetVLAD, CVPR 2016, Eq. (4).
    """

    def __init__(self, clusters: int, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, clusters, 1, bias=False)
        self.centroids = nn.Parameter(torch.rand(clusters, channels))

    def forward(self, x: Tensor) -> Tensor:
        x = F.normalize(x, dim=1)
        share = torch.softmax(self.conv(x).flatten(2), 1)
        # sum over cells of share (x - centre) = share x^T - (sum of share) centre
        residual = share @ x.flatten(2).transpose(1, 2) - share.sum(2, keepdim=True) * self.centroids
        return F.normalize(F.normalize(residual, dim=2).flatten(1), dim=1)


def vlad(features: Tensor, centres: Tensor) -> Tensor:
    """Hard assignment by cosine, `[B, N, C]` and `[K, C]` -> `[B, K C]`: sums of residuals of normalised features,
    normalised per centre, then whole. A centre that no feature belongs to gives zeros.

    Reference: Keetha et al., AnyLoc, RA-L 2024, Sec. IV-B.
    """
    features = F.normalize(features, dim=2)
    nearest = (features @ F.normalize(centres, dim=1).T).argmax(2)
    share = F.one_hot(nearest, len(centres)).to(features.dtype).transpose(1, 2)
    residual = share @ features - share.sum(2, keepdim=True) * centres
    return F.normalize(F.normalize(residual, dim=2).flatten(1), dim=1)
