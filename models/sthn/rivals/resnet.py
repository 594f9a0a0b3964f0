"""ResNet-50 up to its fourth stage, as the STGL baselines use it. Names of parameters are torchvision's, in a Sequential.

Reference: He et al., Deep Residual Learning for Image Recognition, CVPR 2016, Table 1.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

BLOCKS = (3, 4, 6)


class Bottleneck(nn.Module):
    """1 x 1, 3 x 3 (with the stride), 1 x 1 to four times the channels, beside a shortcut."""

    def __init__(self, channels_in: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(channels_in, channels, 1, bias=False), nn.BatchNorm2d(channels)
        self.conv2, self.bn2 = nn.Conv2d(channels, channels, 3, stride, 1, bias=False), nn.BatchNorm2d(channels)
        self.conv3, self.bn3 = nn.Conv2d(channels, 4 * channels, 1, bias=False), nn.BatchNorm2d(4 * channels)
        self.downsample = None
        if stride != 1 or channels_in != 4 * channels:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels_in, 4 * channels, 1, stride, bias=False), nn.BatchNorm2d(4 * channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.bn1(self.conv1(x)))
        y = torch.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return torch.relu(y + (x if self.downsample is None else self.downsample(x)))


def resnet50_conv4(width: int = 64, blocks: tuple[int, int, int] = BLOCKS) -> nn.Sequential:
    """`[B, 3, n, n]` -> `[B, 16 width, n/16, n/16]`."""
    layers: list[nn.Module] = [nn.Conv2d(3, width, 7, 2, 3, bias=False), nn.BatchNorm2d(width), nn.ReLU()]
    layers.append(nn.MaxPool2d(3, 2, 1))
    before = width
    for index, count in enumerate(blocks):
        channels = width * 2**index
        stage = [Bottleneck(before, channels, 1 if index == 0 else 2)]
        stage += [Bottleneck(4 * channels, channels, 1) for _ in range(count - 1)]
        layers.append(nn.Sequential(*stage))
        before = 4 * channels
    return nn.Sequential(*layers)
