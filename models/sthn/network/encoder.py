"""The feature encoder: an image in 0..1 -> 256 channels at a quarter of its size.

Attribute names are the keys of the released checkpoints.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

FEATURES = 256
"""Channels of a feature map."""

IMAGE_NET_MEAN = (0.485, 0.456, 0.406)
IMAGE_NET_STD = (0.229, 0.224, 0.225)


def normalise(image: Tensor) -> Tensor:
    """`[B, 3, H, W]` in 0..1 -> ImageNet mean and standard deviation. Constants, not buffers: released checkpoints
    hold none. It precedes the first convolution's zero padding, so it cannot be folded into the weights."""
    mean = torch.tensor(IMAGE_NET_MEAN, dtype=image.dtype, device=image.device).view(1, 3, 1, 1)
    std = torch.tensor(IMAGE_NET_STD, dtype=image.dtype, device=image.device).view(1, 3, 1, 1)
    return (image - mean) / std


def instance_norm(x: Tensor) -> Tensor:
    """Per image and channel, without weights or running statistics, in evaluation too: features of a crop are not the
    crop of the features."""
    return F.instance_norm(x, eps=1e-5)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside a 1x1 projection that is there even where the channels stay."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, padding=1)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.downsample = nn.Sequential(nn.Conv2d(channels_in, channels_out, 1))

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(instance_norm(self.conv1(x)))
        y = torch.relu(instance_norm(self.conv2(y)))
        return torch.relu(instance_norm(self.downsample(x)) + y)


class QuarterEncoder(nn.Module):
    """`[B, 3, W, W]` in 0..1 -> `[B, 256, W/4, W/4]`. The only down-sampling is by two max-pools."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, padding=3)
        self.layer2 = nn.Sequential(ResidualBlock(64, 64), ResidualBlock(64, 64))
        self.layer3 = nn.Sequential(ResidualBlock(64, 96), ResidualBlock(96, 96))
        self.conv2 = nn.Conv2d(96, FEATURES, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, image: Tensor) -> Tensor:
        x = torch.relu(instance_norm(self.conv1(normalise(image))))
        x = self.layer2(F.max_pool2d(x, 2))
        x = self.layer3(F.max_pool2d(x, 2))
        return self.conv2(x)
