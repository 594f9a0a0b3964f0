"""DHN: the homography as a regression from the two images, laid on each other.

Reference: DeTone, Malisiewicz, Rabinovich, Deep Image Homography Estimation, 2016 (arXiv 1606.03798), Sec. IV, Fig. 4: gray
images of 128 px, eight 3 x 3 convolutions with BatchNorm, three max-pools, 1024 hidden units with dropout, eight numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

CHANNELS = (64, 64, 64, 64, 128, 128, 128, 128)
POOL_AFTER = (1, 3, 5)


class Dhn(nn.Module):
    """Map and frame `[B, 3, n, n]` in 0..1 -> displacements `[1, B, 2, 2, 2]`, pixels of the input."""

    def __init__(self, side_px: int = 128, hidden: int = 1024, width: int = 64) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = 2
        for index, channels in enumerate(CHANNELS):
            channels = channels * width // 64
            layers += [nn.Conv2d(before, channels, 3, padding=1), nn.BatchNorm2d(channels), nn.ReLU()]
            if index in POOL_AFTER:
                layers.append(nn.MaxPool2d(2))
            before = channels
        self.features = nn.Sequential(*layers)
        self.head = nn.Sequential(
            nn.Flatten(),
            nn.Dropout(0.5),
            nn.Linear(before * (side_px // 8) ** 2, hidden),
            nn.ReLU(),
            nn.Dropout(0.5),
            nn.Linear(hidden, 8),
        )
        self.scale = side_px / 4  # the paper divides its labels, at most 32 px, by 32

    def forward(self, map_image: Tensor, frame: Tensor) -> Tensor:
        gray = torch.cat([map_image.mean(1, keepdim=True), frame.mean(1, keepdim=True)], 1)
        return self.head(self.features((gray - 0.5) * 2)).unflatten(1, (2, 2, 2))[None] * self.scale
