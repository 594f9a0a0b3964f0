"""DINOv2's vision transformer, as far as AnyLoc reads it: the values of one layer's attention.

Names of parameters are those of the released backbones (`dinov2_vits14_pretrain.pth` ... `vitg14`, without registers);
sizes are read from the weights. Reference: Oquab et al., DINOv2, TMLR 2024; Dosovitskiy et al., ViT, ICLR 2021.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

HEAD_CHANNELS = 64
PATCH_PX = 14


class LayerScale(nn.Module):
    """A learned factor per channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class Attention(nn.Module):
    """Self-attention with one projection for query, key and value."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        b, n, c = x.shape
        query, key, value = self.qkv(x).view(b, n, 3, self.heads, c // self.heads).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(query, key, value).transpose(1, 2).reshape(b, n, c))


class Mlp(nn.Module):
    """Two layers with GELU."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(channels, hidden), nn.Linear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class SwiGlu(nn.Module):
    """The gated form that ViT-g has."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.w12, self.w3 = nn.Linear(channels, 2 * hidden), nn.Linear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        gate, value = self.w12(x).chunk(2, -1)
        return self.w3(F.silu(gate) * value)


class Block(nn.Module):
    """Pre-norm transformer block with layer scale."""

    def __init__(self, channels: int, heads: int, mlp: nn.Module) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(channels, eps=1e-6), nn.LayerNorm(channels, eps=1e-6)
        self.attn, self.mlp = Attention(channels, heads), mlp
        self.ls1, self.ls2 = LayerScale(channels), LayerScale(channels)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class PatchEmbed(nn.Module):
    """Patches of 14 px -> tokens."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, channels, PATCH_PX, PATCH_PX)

    def forward(self, image: Tensor) -> Tensor:
        return self.proj(image)


class DinoV2(nn.Module):
    """Images `[B, 3, 14 a, 14 b]`, ImageNet-normalised -> `values` of a layer, `[B, a b, C]`."""

    def __init__(self, channels: int, depth: int, hidden: int, gated: bool, places: int = 37**2) -> None:
        super().__init__()
        self.patch_embed = PatchEmbed(channels)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, channels))
        self.pos_embed = nn.Parameter(torch.zeros(1, places + 1, channels))
        self.mask_token = nn.Parameter(torch.zeros(1, channels))  # of pre-training; in the files, not used
        kind = SwiGlu if gated else Mlp
        heads = max(1, channels // HEAD_CHANNELS)
        self.blocks = nn.ModuleList([Block(channels, heads, kind(channels, hidden)) for _ in range(depth)])
        self.norm = nn.LayerNorm(channels, eps=1e-6)

    @classmethod
    def like(cls, state: dict[str, Tensor]) -> DinoV2:
        """A network of the sizes of released weights. Raises KeyError for a key that is missing."""
        depth = 1 + max((int(key.split(".")[1]) for key in state if key.startswith("blocks.")), default=-1)
        gated = "blocks.0.mlp.w3.weight" in state
        hidden = state["blocks.0.mlp.w3.weight"].shape[1] if gated else state["blocks.0.mlp.fc1.weight"].shape[0]
        return cls(state["cls_token"].shape[2], depth, hidden, gated, state["pos_embed"].shape[1] - 1)

    def tokens(self, image: Tensor) -> Tensor:
        """Class token and patches, with their places."""
        patches = self.patch_embed(image)
        rows, columns = patches.shape[-2:]
        own, places = self.pos_embed[:, :1], self.pos_embed[:, 1:]
        side = round(places.shape[1] ** 0.5)
        if (rows, columns) != (side, side):
            # The public code adds 0.1 to the wanted size before it takes the ratio; weights expect those samples.
            grid = places.transpose(1, 2).unflatten(2, (side, side))
            factor = ((rows + 0.1) / side, (columns + 0.1) / side)
            grid = F.interpolate(grid, scale_factor=factor, mode="bicubic")
            places = grid.flatten(2).transpose(1, 2)
        x = patches.flatten(2).transpose(1, 2) + places
        return torch.cat([(self.cls_token + own).expand(len(image), -1, -1), x], 1)

    def values(self, image: Tensor, layer: int) -> Tensor:
        """Values (the third part of qkv) of the patches in block `layer`, counted from 0."""
        x = self.tokens(image)
        for block in self.blocks[:layer]:
            x = block(x)
        block = self.blocks[layer]
        return block.attn.qkv(block.norm1(x))[:, 1:].chunk(3, -1)[2]
