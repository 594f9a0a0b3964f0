"""The calibrated model in numpy: `[integrity]` of `bundle.toml`, evaluated as `src/model/integrity.rs` does."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALL = 1e-3
"""Keeps logarithms finite."""


def transform(kind: str, x: Array) -> Array:
    """A cue's transform."""
    if kind == "linear":
        return x
    if kind == "log":
        return np.log(np.maximum(x, 0.0) + SMALL)
    if kind == "logit":
        x = np.clip(x, 0.0, 1.0)
        return np.log((x + SMALL) / (1.0 - x + SMALL))
    raise ValueError(f"transform: expected linear, log or logit, found {kind}")


def terms(table: dict[str, Any], evidence: dict[str, Array]) -> Array:
    """`[frames, cues]`: transformed and clipped."""
    columns = []
    for cue in table["cues"]:
        if cue["name"] not in evidence:
            raise KeyError(f"evidence: expected {cue['name']}, found {', '.join(sorted(evidence))}")
        columns.append(np.clip(transform(cue["transform"], evidence[cue["name"]]), cue["low"], cue["high"]))
    return np.stack(columns, 1)


def judge(table: dict[str, Any], evidence: dict[str, Array]) -> tuple[Array, Array]:
    """Probability of an error above the bound, and the match error's sigma per axis, metres."""
    x = terms(table, evidence)
    score = table["bias"] + x @ [cue["weight"] for cue in table["cues"]]
    ln_sigma = table["sigma"]["bias"] + x @ [cue["sigma_weight"] for cue in table["cues"]]
    p = np.interp(score, table["probability"]["scores"], table["probability"]["p"])
    return p, np.clip(np.exp(ln_sigma), table["sigma"]["least_m"], table["sigma"]["most_m"])
