"""What is trained and its loss. Paper Eq. (3), (5), (6).

A task is a module: images and truth in, loss and displacements out. The loop knows no more of it, so that other networks
train by the same loop.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn

from ..network import Match, Sthn, combine
from .box import augmented


class Task(Protocol):
    """A module with `forward(window, thermal, truth, drawn)`.

    `window`: u8 `[B, W_S, W_S, 3]`; `thermal`: u8 `[B, F, F]`; `truth`: `[B, 2, 2, 2]`, pixels of the W_R input; `drawn`:
    `[B, 3]` of `box.draw`, or None outside training. Returns `loss` (a scalar), `final` and, where there is one, `coarse`
    (`[B, 2, 2, 2]`); other entries are scalars for the curve.
    """

    def __call__(self, window: Tensor, thermal: Tensor, truth: Tensor, drawn: Tensor | None = None) -> dict[str, Tensor]: ...

    def nets(self) -> dict[str, nn.Module]:
        """Nets whose gradients are clipped apart, by the names they are saved under."""
        ...


def images(window: Tensor, thermal: Tensor) -> tuple[Tensor, Tensor]:
    """As loaded -> `[B, 3, W_S, W_S]` and `[B, 3, F, F]` in 0..1."""
    return window.permute(0, 3, 1, 2).float() / 255, (thermal[:, None].float() / 255).expand(-1, 3, -1, -1)


def sequence_loss(iterations: Tensor, truth: Tensor, gamma: float) -> Tensor:
    """L = sum over k of gamma^(K-k-1) L1(D_k - D_gt), L1 as a mean. Eq. (3)

    `iterations`: `[K, B, 2, 2, 2]`.
    """
    count = iterations.shape[0]
    weights = gamma ** torch.arange(count - 1, -1, -1, device=iterations.device, dtype=iterations.dtype)
    return (weights * (iterations - truth).abs().flatten(1).mean(1)).sum()


class SthnTask(nn.Module):
    """The published network, one or two stages."""

    def __init__(self, network: Sthn, gamma: float = 0.85) -> None:
        super().__init__()
        self.network, self.gamma = network, gamma

    def nets(self) -> dict[str, nn.Module]:
        found = {"netG": self.network.netG}
        return found | ({"netG_fine": self.network.netG_fine} if self.network.netG_fine is not None else {})

    def forward(self, window: Tensor, thermal: Tensor, truth: Tensor, drawn: Tensor | None = None) -> dict[str, Tensor]:
        config = self.network.config
        box_of = None if drawn is None else (lambda displacement: augmented(displacement, config, drawn))
        match: Match = self.network(*images(window, thermal), box_of)
        coarse = sequence_loss(match.coarse_iterations, truth, self.gamma)
        out = {"loss_coarse": coarse, "coarse": match.coarse_iterations[-1], "final": match.final}
        if match.fine_iterations is None or match.box is None:
            return out | {"loss": coarse}
        # On the scale of the coarse input, where kappa = eta / alpha stands before each L1.                (5)
        mapped = torch.stack([combine(step, match.box, config) for step in match.fine_iterations])
        fine = sequence_loss(mapped, truth, self.gamma)
        return out | {"loss_fine": fine, "loss": coarse + fine}  # (6)
