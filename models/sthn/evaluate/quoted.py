"""The paper's own numbers (`paper.toml`), and where they may stand: beside results on the paper's data, nowhere else."""

from __future__ import annotations

import functools
import tomllib
from importlib import resources
from typing import Any

MARK = "quoted"
"""Stands beside every number that is the paper's."""


@functools.cache
def paper() -> dict[str, Any]:
    """`paper.toml`."""
    text = resources.files(__package__).joinpath("paper.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def same_data(source: dict[str, Any]) -> bool:
    """Whether a source (as stored in results) is the paper's: the published HDF5 layout, its test split, of its size.
    How many of its pairs were evaluated is another matter, and the tables say it."""
    data = paper()["data"]
    wanted = {"kind": "boson", "split": data["split"], "queries": data["queries"]}
    return all(source.get(name) == value for name, value in wanted.items())


def latency_share(method: str, of: str = "STGL-GeM-ResNet50") -> float:
    """Latency of a row of Table II over that of another, from the table."""
    latency = {row["method"]: row["latency_ms"] for row in paper()["table_2"]["rows"]}
    return latency[method] / latency[of]
