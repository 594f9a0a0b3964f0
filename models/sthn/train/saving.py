"""What a training writes: released layouts, and checkpoints to go on from.

RUN/checkpoints/step-00010000.pt    everything to go on bit for bit; `--resume` takes the last, `--resume PATH` any
RUN/best/, RUN/final/               config.json and model.safetensors, as released: `sthn.export RUN/final`
RUN/STHN.pth                        {"netG", "netG_fine"}, the authors' other layout
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import nn

from ..checkpoint import CheckpointError, load_state, read_state, stated_lookup
from ..network import Sthn


def save_released(network: Sthn, folder: Path) -> None:
    """The directory layout of a released checkpoint, and the direction of the look-up."""
    folder.mkdir(parents=True, exist_ok=True)
    config = {"model_config": dataclasses.asdict(network.config), "lookup": network.netG.lookup.value}
    (folder / "config.json").write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")
    state = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    save_file(state, str(folder / "model.safetensors"))


def save_pth(nets: dict[str, nn.Module], path: Path) -> None:
    """The `.pth` layout."""
    fine = nets.get("netG_fine")
    torch.save({"netG": nets["netG"].state_dict(), "netG_fine": fine.state_dict() if fine is not None else None}, path)


def start_from(network: Sthn, path: Path) -> None:
    """Weights of a checkpoint as a start: all of them, or the coarse ones for a network with a new fine stage. Strict:
    every key of the stages that the checkpoint holds."""
    if (stated := stated_lookup(path)) not in (None, network.netG.lookup):
        raise CheckpointError(f"{path}: lookup: expected {network.netG.lookup.value}, found {stated.value}")
    state = read_state(path)
    if network.netG_fine is not None and not any(key.startswith("netG_fine.") for key in state):
        state |= {key: value for key, value in network.state_dict().items() if key.startswith("netG_fine.")}
    load_state(network, state, str(path))


def write_atomically(state: dict[str, Any], path: Path) -> None:
    """A checkpoint that is whole or not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(state, path.with_suffix(".tmp"))
    path.with_suffix(".tmp").replace(path)


def last_checkpoint(out: Path) -> Path:
    """The newest one in a run's folder."""
    found = sorted((out / "checkpoints").glob("step-*.pt"))
    if not found:
        raise CheckpointError(f"{out}/checkpoints: no step-*.pt to go on from")
    return found[-1]


def load(path: Path) -> dict[str, Any]:
    """A checkpoint of `write_atomically`."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for a file that is missing, cut or not a checkpoint
        raise CheckpointError(f"{path}: {error}") from error
    if not isinstance(state, dict) or "step" not in state:
        raise CheckpointError(f"{path}: expected a training's checkpoint, found another file")
    return state
