"""What an evaluation leaves: every score of every pair, so that tables and figures need no second run.

`results.json`: the command, the source, the methods, the conditions (D_C, noise, pairs) and one cell for each method under
each condition. Pictured pairs also have their quads, relative to the window's middle in metres, and two small pictures.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..data import Noise, Pair
from .metrics import Score, Summary

SCHEMA = 1
Quad = list[list[float]]


class ResultsError(ValueError):
    """Stored results that are not what they must be. The text names file, field, expected and found."""


@dataclass(frozen=True)
class PairRecord:
    """A pair that was evaluated."""

    name: str
    terrain: str
    truth: Quad | None = None
    """The frame's edges relative to the window's middle, metres; of pictured pairs."""
    picture: str | None = None
    """Stem of its pictures in the results' folder: `<stem>-satellite.jpg`, `<stem>-thermal.jpg`."""
    picture_width_m: float | None = None
    """Ground that the satellite picture shows."""


@dataclass(frozen=True)
class Condition:
    """One column of the tables: where frames lie, which noise, which pairs."""

    search_radius_m: float
    """D_C."""
    noise: Noise
    digest: str
    """Of all pairs: frames, and where they lie relative to the window's middle. W_S does not change it."""
    pairs: list[PairRecord]

    @property
    def key(self) -> tuple[float, str]:
        """What a table calls it."""
        return self.search_radius_m, noise_name(self.noise)


@dataclass(frozen=True)
class PairScore(Score):
    """A score with what it cost and, of pictured pairs, where the answer lies."""

    seconds: float = 0.0
    stages_s: dict[str, float] = field(default_factory=dict)
    quad: Quad | None = None
    coarse: Quad | None = None


@dataclass(frozen=True)
class Method:
    """A row of the tables."""

    label: str
    spec: str
    """As given on the command line."""
    window_m: float
    """W_S."""


@dataclass(frozen=True)
class Cell:
    """A method under a condition."""

    method: str
    condition: int
    scores: list[PairScore]
    note: str = ""
    """Stands beside the row: a short run, or why there are no scores."""

    def summary(self) -> Summary:
        """Over all pairs."""
        return Summary.of(self.scores)

    def latency_ms(self) -> float | None:
        """Median of a pair."""
        return float(np.median([s.seconds for s in self.scores]) * 1e3) if self.scores else None

    def stages_ms(self) -> dict[str, float]:
        """Median of each stage that says what it took."""
        names = dict.fromkeys(name for s in self.scores for name in s.stages_s)
        return {n: float(np.median([s.stages_s[n] for s in self.scores if n in s.stages_s]) * 1e3) for n in names}


@dataclass
class Results:
    """One run of the evaluation."""

    command: str
    source: dict[str, Any]
    """What the pairs are of: see `sthn.evaluate.run`."""
    methods: list[Method] = field(default_factory=list)
    conditions: list[Condition] = field(default_factory=list)
    cells: list[Cell] = field(default_factory=list)
    folder: Path | None = None
    """Where it was read from."""

    def method(self, label: str) -> Method:
        """By its label."""
        for method in self.methods:
            if method.label == label:
                return method
        raise ResultsError(f"method: expected one of {', '.join(m.label for m in self.methods)}, found {label}")

    def of(self, label: str) -> Iterator[tuple[Condition, Cell]]:
        """The cells of a method with their conditions."""
        for cell in self.cells:
            if cell.method == label:
                yield self.conditions[cell.condition], cell

    def write(self, folder: Path) -> Path:
        """`results.json` in `folder`; written whole or not at all."""
        folder.mkdir(parents=True, exist_ok=True)
        document = {"schema": SCHEMA, **{f.name: _plain(getattr(self, f.name)) for f in dataclasses.fields(self)}}
        del document["folder"]
        path = folder / "results.json"
        part = path.with_suffix(".part")
        part.write_text(json.dumps(document, allow_nan=False, separators=(",", ":")) + "\n")
        part.replace(path)
        return path

    @classmethod
    def read(cls, path: Path) -> Results:
        """From a `results.json` or its folder."""
        path = path / "results.json" if path.is_dir() else path
        try:
            document = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise ResultsError(f"{path}: {error}") from error
        if not isinstance(document, dict) or document.get("schema") != SCHEMA:
            found = document.get("schema") if isinstance(document, dict) else type(document).__name__
            raise ResultsError(f"{path}: schema: expected {SCHEMA}, found {found}")
        try:
            return cls(
                document["command"],
                document["source"],
                [Method(**m) for m in document["methods"]],
                [_condition(c) for c in document["conditions"]],
                [Cell(c["method"], c["condition"], [PairScore(**s) for s in c["scores"]], c["note"]) for c in document["cells"]],
                path.parent,
            )
        except (KeyError, TypeError) as error:
            raise ResultsError(f"{path}: expected the fields of sthn.evaluate.results, found another: {error}") from error


def _condition(document: dict[str, Any]) -> Condition:
    pairs = [PairRecord(**p) for p in document["pairs"]]
    return Condition(document["search_radius_m"], Noise(**document["noise"]), document["digest"], pairs)


def _plain(value: Any) -> Any:
    """For JSON; what is empty or None in a dataclass is left out."""
    if dataclasses.is_dataclass(value):
        named = {f.name: (getattr(value, f.name), f) for f in dataclasses.fields(value)}
        return {n: _plain(v) for n, (v, f) in named.items() if not (v is None and f.default is None)}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return round(value, 6) if isinstance(value, float) else value


def noise_name(noise: Noise) -> str:
    """`none`, `rotation 10`, `scale 0.2`, `perspective 16`; several joined by `+`."""
    bounds = {"rotation": noise.rotation_deg, "scale": noise.scale, "perspective": noise.perspective_px}
    return " + ".join(f"{kind} {bound:g}" for kind, bound in bounds.items() if bound > 0) or "none"


class PairsDigest:
    """Of the pairs of a condition, in order: the same for every W_S."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(self, pair: Pair) -> None:
        """The next pair."""
        self._hash.update(pair.name.encode() + b"\0" + np.ascontiguousarray(pair.thermal).tobytes())
        self._hash.update(" ".join(f"{v + 0.0:.3f}" for v in np.round(relative_m(pair, pair.quad()), 3).ravel()).encode())

    def hex(self) -> str:
        """16 hex digits."""
        return self._hash.hexdigest()[:16]


def relative_m(pair: Pair, quad: np.ndarray) -> np.ndarray:
    """Window px -> metres from the window's middle."""
    return (np.asarray(quad) - (pair.satellite.shape[0] - 1) / 2) * pair.m_per_px
