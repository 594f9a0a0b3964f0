"""Checkpoints of the TGM in the published layout.

A `.pth` with `epoch_num`, `model_netG_state_dict`, `model_netD_state_dict`, `optimizer_netG_state_dict`,
`optimizer_netD_state_dict`; weights carry DataParallel's prefix `module.` (accepted with and without). Ours adds
`training`: what a resumed run needs. Sizes are read from the weights. Loading is strict.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .networks import Discriminator, Generator

GENERATOR, DISCRIMINATOR = "model_netG_state_dict", "model_netD_state_dict"
PREFIX = "module."


class TgmError(ValueError):
    """What a TGM command cannot work with. The text names file, field, expected and found."""


def read(path: str | Path) -> dict[str, Any]:
    """The table of a checkpoint. Nothing in it is run; numpy's scalars, which the published code leaves beside the
    weights, are let through."""
    kinds = {type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8")}
    allowed = [np._core.multiarray.scalar, np.dtype, *kinds]
    try:
        with torch.serialization.safe_globals(allowed):
            document = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for a file that is missing, cut or not a checkpoint
        raise TgmError(f"{path}: {error}") from error
    if not isinstance(document, dict) or GENERATOR not in document:
        found = ", ".join(map(str, document)) if isinstance(document, dict) else type(document).__name__
        raise TgmError(f"{path}: expected a table with {GENERATOR}, found {found or 'an empty one'}")
    return document


def load_generator(path: str | Path, tanh: bool = False) -> Generator:
    """The generator of a checkpoint, in evaluation mode. `tanh` leaves no trace in the weights: the caller must know."""
    state = plain(read(path)[GENERATOR], str(path), GENERATOR)
    first = state.get("model.model.0.weight")
    if first is None or first.ndim != 4:
        raise TgmError(f"{path}: {GENERATOR}: missing model.model.0.weight")
    depth = max(key.count(".model.") for key in state)
    try:
        net = Generator(depth, first.shape[0], tanh)
    except ValueError as error:
        raise TgmError(f"{path}: {GENERATOR}: {error}") from error
    load_strictly(net, state, str(path), GENERATOR)
    return net.eval()


def load_strictly(net: nn.Module, state: dict[str, Tensor], path: str, field: str) -> None:
    """Every key of either must be in the other, with the same shape."""
    wanted = net.state_dict()
    for what, keys in (("missing", wanted.keys() - state.keys()), ("unexpected", state.keys() - wanted.keys())):
        if keys:
            named = ", ".join(sorted(keys)[:12]) + (f" and {len(keys) - 12} more" if len(keys) > 12 else "")
            raise TgmError(f"{path}: {field}: {what} {named}")
    for key, value in wanted.items():
        if state[key].shape != value.shape:
            raise TgmError(f"{path}: {field}: {key}: expected shape {tuple(value.shape)}, found {tuple(state[key].shape)}")
        if not torch.isfinite(state[key]).all():
            raise TgmError(f"{path}: {field}: {key}: expected finite numbers, found NaN or infinity")
    net.load_state_dict(state, strict=True)


def plain(state: object, path: str, field: str) -> dict[str, Tensor]:
    """Keys without the leading `module.`."""
    if not isinstance(state, dict):
        raise TgmError(f"{path}: {field}: expected a table of tensors, found {type(state).__name__}")
    bad = [str(key) for key, value in state.items() if not isinstance(value, Tensor)]
    if bad:
        raise TgmError(f"{path}: {field}: {bad[0]}: expected a tensor, found {type(state[bad[0]]).__name__}")
    return {re.sub(rf"^{re.escape(PREFIX)}", "", str(key)): value for key, value in state.items()}


def published(net: nn.Module) -> dict[str, Tensor]:
    """Weights under DataParallel's keys."""
    return {PREFIX + key: value for key, value in net.state_dict().items()}


def save(
    path: Path,
    epoch: int,
    generator: Generator,
    discriminator: Discriminator,
    optimisers: dict[str, torch.optim.Optimizer],
    training: dict[str, Any],
) -> None:
    """Writes a checkpoint, whole or not at all. `optimisers`: netG, netD."""
    document = {
        "epoch_num": epoch,
        GENERATOR: published(generator),
        DISCRIMINATOR: published(discriminator),
        **{f"optimizer_{name}_state_dict": optimiser.state_dict() for name, optimiser in optimisers.items()},
        "training": training,
    }
    torch.save(document, path.with_suffix(".tmp"))
    path.with_suffix(".tmp").replace(path)
