"""Released checkpoints, loaded strictly: a missing or extra key, or a wrong shape, is an error that names it.

Layouts:
* a directory with `config.json` and `model.safetensors` (else `pytorch_model.bin`): flat keys `netG.*`, `netG_fine.*`.
  One of `sthn.train` has the direction of the look-up, `lookup`, beside the released `model_config`;
* a `.pth` file: `{"netG": {...}, "netG_fine": {...} or None}`, keys with or without `module.`. It states no
  configuration, so that the caller must.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from .network import Lookup, NetworkConfig, Sthn

STAGES = ("netG", "netG_fine")


class CheckpointError(ValueError):
    """A checkpoint that is not what the network needs. The text names file, key, expected and found."""


def load_checkpoint(
    path: str | Path, config: NetworkConfig | None = None, fine: str | Path | None = None, lookup: Lookup | None = None
) -> Sthn:
    """Loads a released checkpoint, in evaluation mode.

    `config`: needed for a `.pth`; for a directory it replaces `config.json` (another padding, say).
    `fine`: a second `.pth` whose `netG` becomes the fine network (the authors' `--eval_model_fine`).
    `lookup`: its direction, for weights that state none; the published one where nobody says.
    Files are read with `weights_only=True`: a pickle cannot run code.
    """
    path = Path(path)
    if path.is_dir():
        config = config or NetworkConfig.read(path / "config.json")
        state = _read_directory(path)
    else:
        if config is None:
            raise CheckpointError(f"{path}: a .pth file states no configuration: correlation levels and sizes must be given")
        state = _read_pth(path)
    if fine is not None:
        state = {key: value for key, value in state.items() if not key.startswith("netG_fine.")}
        other = _read_pth(Path(fine))
        state |= {f"netG_fine.{key.removeprefix('netG.')}": value for key, value in other.items() if key.startswith("netG.")}
    stated = stated_lookup(path)
    if None not in (lookup, stated) and lookup != stated:
        raise CheckpointError(f"{path}: lookup: expected {stated.value}, as it was trained, found {lookup.value}")
    network = Sthn(config, lookup or stated or Lookup.PUBLISHED)
    load_state(network, state, str(path))
    return network.eval()


def read_experiment(path: Path) -> dict[str, Any] | None:
    """`experiment.json` of the training that left a checkpoint (`RUN/best`, `RUN/final`, `RUN/STHN.pth`); None beside others."""
    file = path.resolve().parent / "experiment.json"
    return _read_json(file) if file.is_file() else None


def stated_lookup(path: Path) -> Lookup | None:
    """The direction that a checkpoint was trained with, of `config.json` or its training; released ones state none."""
    config = _read_json(path / "config.json") if (path / "config.json").is_file() else {}
    value = config.get("lookup") or ((read_experiment(path) or {}).get("network") or {}).get("lookup")
    try:
        return None if value is None else Lookup(value)
    except ValueError:
        known = " | ".join(direction.value for direction in Lookup)
        raise CheckpointError(f"{path}: lookup: expected {known}, found {value!r}") from None


def _read_json(file: Path) -> dict[str, Any]:
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{file}: {error}") from error
    if not isinstance(document, dict):
        raise CheckpointError(f"{file}: expected a table, found {_describe(document)}")
    return document


def one_stage(network: Sthn) -> Sthn:
    """The coarse stage alone of a two-stage network, sharing its weights."""
    alone = Sthn(dataclasses.replace(network.config, two_stages=False), network.netG.lookup)
    alone.netG = network.netG
    return alone.train(network.training)


def read_state(path: str | Path) -> dict[str, Tensor]:
    """The weights of a checkpoint in either layout, keys with stage prefix."""
    path = Path(path)
    return _read_directory(path) if path.is_dir() else _read_pth(path)


def load_state(network: Sthn, state: dict[str, Tensor], name: str) -> None:
    """Copies `state` (keys with stage prefix) into `network`; every key of either must be in the other."""
    wanted = network.state_dict()
    if missing := sorted(wanted.keys() - state.keys()):
        raise CheckpointError(f"{name}: missing {_some(missing)}")
    if extra := sorted(state.keys() - wanted.keys()):
        raise CheckpointError(f"{name}: unexpected {_some(extra)}")
    for key, value in wanted.items():
        if state[key].shape != value.shape:
            raise CheckpointError(f"{name}: {key}: expected shape {tuple(value.shape)}, found {tuple(state[key].shape)}")
        if not torch.isfinite(state[key]).all():
            raise CheckpointError(f"{name}: {key}: expected finite numbers, found NaN or infinity")
    network.load_state_dict(state, strict=True)


def _some(keys: list[str], most: int = 12) -> str:
    more = f" and {len(keys) - most} more" if len(keys) > most else ""
    return ", ".join(keys[:most]) + more


def _read_directory(folder: Path) -> dict[str, Tensor]:
    safe, pickled = folder / "model.safetensors", folder / "pytorch_model.bin"
    if safe.is_file():
        try:
            return _without_module(load_file(str(safe)), safe)
        except CheckpointError:
            raise
        except Exception as error:  # safetensors has no public error type of its own for every fault
            raise CheckpointError(f"{safe}: {error}") from error
    if pickled.is_file():
        return _without_module(_torch_load(pickled), pickled)
    raise CheckpointError(f"{folder}: neither model.safetensors nor pytorch_model.bin")


def _read_pth(path: Path) -> dict[str, Tensor]:
    document = _torch_load(path)
    if not isinstance(document, dict) or "netG" not in document:
        raise CheckpointError(f"{path}: expected a table with netG, found {_describe(document)}")
    if extra := sorted(str(key) for key in document if key not in STAGES):
        raise CheckpointError(f"{path}: unexpected {_some(extra)}")
    flat = {}
    for stage in STAGES:
        weights = document.get(stage)
        if weights is None:
            continue
        if not isinstance(weights, dict):
            raise CheckpointError(f"{path}: {stage}: expected a table of tensors, found {_describe(weights)}")
        flat |= {f"{stage}.{key}": value for key, value in _without_module(weights, path).items()}
    return flat


def _torch_load(path: Path) -> object:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for a file that is missing, cut or not a checkpoint
        raise CheckpointError(f"{path}: {error}") from error


def _without_module(weights: object, path: Path) -> dict[str, Tensor]:
    """DataParallel's `module.` taken out of the keys."""
    if not isinstance(weights, dict):
        raise CheckpointError(f"{path}: expected a table of tensors, found {_describe(weights)}")
    out: dict[str, Tensor] = {}
    for key, value in weights.items():
        plain = str(key).replace("module.", "")
        if not isinstance(value, Tensor):
            raise CheckpointError(f"{path}: {key}: expected a tensor, found {_describe(value)}")
        if plain in out:
            raise CheckpointError(f"{path}: {key}: the same weight twice, with and without `module.`")
        out[plain] = value
    return out


def _describe(value: object) -> str:
    if isinstance(value, dict):
        return f"a table of {_some(sorted(str(key) for key in value)) or 'nothing'}"
    return type(value).__name__
