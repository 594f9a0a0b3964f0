"""An experiment: one TOML file, which may take another as its base. Every default is written here, once.

Unknown keys are errors. A table of a file is laid over its base's, key by key; `--set a.b=VALUE` over both. A source of
another `kind` replaces the one below it: first its kind, then its keys.
"""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any, Literal

from ..data import DataError, Noise
from ..data.spec import KEYS, check
from ..network import Lookup, NetworkConfig

MAX_BASES = 8


@dataclasses.dataclass(frozen=True)
class NetworkTable:
    """`[network]`: the published architecture's numbers."""

    levels: int
    """Of the coarse correlation: 2 for W_S = 512, 4 for 1024 and 1536."""
    two_stages: bool = False
    resize_width: int = 256
    """W_R."""
    iterations: int = 6
    """K_1."""
    fine_iterations: int = 6
    """K_2."""
    fine_padding: int = 32
    """On each side of the box in evaluation, window px; Delta p4 = 64 in all. Training pads by its augmentation alone."""
    lookup: str = "published"


@dataclasses.dataclass(frozen=True)
class TrainingTable:
    """`[training]`: the published optimisation."""

    steps: int = 200_000
    batch: int = 16
    peak_lr: float = 1e-4
    weight_decay: float = 1e-5
    eps: float = 1e-8
    warm_up: float = 0.05
    """Share of the schedule (steps + 100) in which the rate rises."""
    clip: float = 1.0
    """Largest norm of the gradient, each net apart."""
    gamma: float = 0.85
    init: str = ""
    """A checkpoint in a released layout to start from; a two-stage training starts from a coarse one."""
    precision: str = "32-true"
    """Or "bf16-mixed": convolutions in bfloat16, weights and correlation in single precision."""
    workers: int = 4
    log_every: int = 100
    validate_every: int = 10_000
    save_every: int = 10_000
    picture_every: int = 10_000


@dataclasses.dataclass(frozen=True)
class BoxTable:
    """`[box]`: augmentation of the box B in two-stage training, window px. See `box.py`."""

    kind: str = "full"
    centre_px: float = 64.0
    widen_px: float = 64.0
    rule: str = "code"


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A whole file."""

    row: str
    """Which row of which table of the paper."""
    window_m: int
    """W_S."""
    search_radius_m: float
    """D_C."""
    network: NetworkTable
    training: TrainingTable
    box: BoxTable
    noise: Noise
    """Of the training pairs. Validation has none unless its own table says so."""
    data: dict[str, Any]
    """`root`; `folder` and `map` of all published splits; tables `train`, `validation` and, for the generated set, `extended`
    (`sthn.data.spec`); `extended = false` takes a base's away."""
    seed: int = 0

    @property
    def config(self) -> NetworkConfig:
        """The released `config.json` of what is trained."""
        n = self.network
        return NetworkConfig(
            n.resize_width, self.window_m, n.levels, n.iterations, n.fine_iterations, n.fine_padding, n.two_stages
        )

    @property
    def lookup(self) -> Lookup:
        """Direction of the look-up."""
        return Lookup(self.network.lookup)

    def source_table(self, name: Literal["train", "validation", "extended"]) -> dict[str, Any]:
        """A source's table with what the experiment says once."""
        table = {"window_m": self.window_m, "search_radius_m": self.search_radius_m} | self.data[name]
        if table.get("kind") == "boson":
            table = {key: self.data[key] for key in ("folder", "map") if key in self.data} | table
        if name != "validation" and self.noise.kinds:
            table.setdefault("noise", dataclasses.asdict(self.noise))
        return table

    @property
    def root(self) -> Path:
        """Paths of the sources are relative to it."""
        return Path(self.data.get("root", "."))


TABLES: dict[str, type] = {"network": NetworkTable, "training": TrainingTable, "box": BoxTable, "noise": Noise}
TYPES = {"int": int, "float": float, "str": str, "bool": bool}


def read(path: Path, overrides: list[str] | None = None) -> Experiment:
    """Reads a file with its bases and `a.b=VALUE` (TOML) over them."""
    document = _merged(Path(path), [])
    for text in overrides or []:
        key, equals, value = text.partition("=")
        try:
            parsed = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError as error:
            raise DataError("--set", text, "KEY=VALUE with a TOML value (text in quotes)", error) from error
        if not equals or not key:
            raise DataError("--set", text, "KEY=VALUE", "no =")
        for name in reversed(key.strip().split(".")):
            parsed = {name: parsed}
        document = _over(document, parsed)
    return parse(document, str(path))


def parse(document: dict[str, Any], where: str) -> Experiment:
    """A whole experiment from its tables."""
    plain = {"row": str, "window_m": int, "search_radius_m": float, "seed": int}
    check(document, plain | {name: dict for name in (*TABLES, "data")}, where)
    for key in ("row", "window_m", "search_radius_m", "network", "data"):
        if key not in document:
            raise DataError(where, key, "a value", "nothing")
    tables = {name: _table(kind, document.get(name, {}), f"{where}: {name}") for name, kind in TABLES.items()}
    if document["data"].get("extended") is False:
        document["data"].pop("extended")
    check(
        document["data"],
        {"root": str, "folder": str, "map": str, "train": dict, "validation": dict, "extended": dict},
        f"{where}: data",
    )
    for name in ("train", "validation"):
        if name not in document["data"]:
            raise DataError(f"{where}: data", name, "a table", "nothing")
    if document["data"]["validation"].get("augment"):
        raise DataError(f"{where}: data.validation", "augment", "false: augmentation is for training only", "true")
    if not document["row"]:
        raise DataError(where, "row", "which row of which table", "nothing")
    values = {key: document[key] for key in plain if key in document}
    made = Experiment(**values, **tables, data=document["data"])
    _plausible(made, where)
    return made


def _plausible(made: Experiment, where: str) -> None:
    training, network, box = made.training, made.network, made.box
    ranges = [
        ("training.steps", training.steps, 1, 100_000_000),
        ("training.batch", training.batch, 1, 4096),
        ("training.peak_lr", training.peak_lr, 1e-9, 1.0),
        ("training.clip", training.clip, 1e-9, 1e9),
        ("training.gamma", training.gamma, 0.0, 1.0),
        ("training.warm_up", training.warm_up, 0.0, 1.0),
        ("training.workers", training.workers, 0, 256),
        ("box.centre_px", box.centre_px, 0.0, 4096.0),
        ("box.widen_px", box.widen_px, 0.0, 4096.0),
        ("search_radius_m", made.search_radius_m, 1e-6, 1e6),
    ]
    ranges += [(f"training.{k}", getattr(training, k), 1, 1e9) for k in ("log_every", "validate_every", "save_every")]
    ranges += [("training.picture_every", training.picture_every, 1, 1e9)]
    for key, value, least, most in ranges:
        if not least <= value <= most:
            raise DataError(where, key, f"{least:g} to {most:g}", value)
    choices = [
        ("training.precision", training.precision, ("32-true", "bf16-mixed")),
        ("box.kind", box.kind, ("none", "widen", "full")),
        ("box.rule", box.rule, ("code", "paper")),
        ("network.lookup", network.lookup, tuple(direction.value for direction in Lookup)),
    ]
    for key, value, known in choices:
        if value not in known:
            raise DataError(where, key, " | ".join(known), value)
    made.config  # noqa: B018 - its own checks name the field


def _table(kind: type, table: dict[str, Any], where: str) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    check(table, {name: TYPES[str(field.type)] for name, field in fields.items()}, where)
    for name, field in fields.items():
        if field.default is dataclasses.MISSING and name not in table:
            raise DataError(where, name, "a value", "nothing")
    return kind(**table)


def _merged(path: Path, seen: list[Path]) -> dict[str, Any]:
    if path.resolve() in seen or len(seen) >= MAX_BASES:
        raise DataError(path, "base", f"at most {MAX_BASES} files, none twice", " <- ".join(str(p) for p in seen))
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(path, "file", "a readable TOML file", error) from error
    base = document.pop("base", None)
    if base is None:
        return document
    if not isinstance(base, str):
        raise DataError(path, "base", "a path relative to this file", repr(base))
    return _over(_merged(path.parent / base, [*seen, path.resolve()]), document)


def _over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    other_source = above.get("kind") in KEYS and below.get("kind", above["kind"]) != above["kind"]
    out = {} if other_source else dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = _over(out[key], value) if both else value
    return out
