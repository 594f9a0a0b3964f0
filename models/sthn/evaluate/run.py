"""The run: every method on every pair of every condition, one pair at a time.

A pair is made once, in the widest window that a method wants; the others see its middle (`pairs.narrowed`), so that a
table's rows are of the same pairs whatever their W_S.
"""

from __future__ import annotations

import dataclasses
import os
import platform
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import trange

from ..data import Noise, Noisy, Pair, PairSource
from ..rivals.base import Match, Rival
from . import metrics, pictures
from .methods import Spec, StagedMatch, needed_px, quad_of, stages_s
from .pairs import narrowed
from .results import Cell, Condition, Method, PairRecord, PairScore, PairsDigest, Quad, Results, relative_m

OpenPairs = Callable[[int, float], PairSource]
"""Window px, D_C in metres -> the pairs without noise."""


def parse_noise(text: str) -> Noise:
    """`none`, `rotation=5`, `scale=0.1`, `perspective=8`."""
    names = {"rotation": "rotation_deg", "scale": "scale", "perspective": "perspective_px"}
    kind, equals, bound = text.partition("=")
    if text == "none":
        return Noise()
    try:
        if kind not in names or not float(bound) > 0:
            raise ValueError
        return Noise(**{names[kind]: float(bound)})
    except ValueError as error:
        raise ValueError(f"noise: expected none, rotation=DEG, scale=SHARE or perspective=PX above 0, found {text}") from error


def with_noise(source: PairSource, noise: Noise, seed: int) -> PairSource:
    """Every pair under the one kind of noise that has a bound."""
    kinds = noise.kinds
    if len(kinds) > 1:
        raise ValueError(f"noise: expected one kind in an evaluation, found {', '.join(kinds)}")
    return Noisy(source, noise, seed, kinds[0]) if kinds else source


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is run."""

    specs: Sequence[Spec]
    radii_m: Sequence[float]
    noises: Sequence[Noise]
    seed: int
    pictures: int = 0
    device: str = "cpu"
    """Of checkpoints."""


def run(plan: Plan, open_pairs: OpenPairs, source: dict[str, Any], out: Path, command: str) -> Results:
    """Runs the plan and writes `results.json` after every condition."""
    results = Results(command, source | {"machine": machine(plan.device)}, folder=out)
    opened: dict[str, Rival] = {}
    for radius in plan.radii_m:
        for spec in plan.specs:
            # Weights that are one for all conditions are read once; a bundle's search disc follows D_C.
            if spec.text not in opened or spec.by_radius or spec.kind == "bundle":
                opened[spec.text] = spec.open(radius, plan.device)
        methods = [opened[spec.text] for spec in plan.specs]
        scale = float(source.get("m_per_px", 1.0))
        _add_methods(results, plan.specs, methods, scale)
        width = max(needed_px(method, scale) for method in methods)
        plain = open_pairs(width, radius)
        for noise in plan.noises:
            _run_condition(results, plan, methods, with_noise(plain, noise, plan.seed), radius, noise, out)
            results.write(out)
    return results


def _add_methods(results: Results, specs: Sequence[Spec], methods: Sequence[Rival], m_per_px: float) -> None:
    if results.methods:
        return
    for spec, method in zip(specs, methods, strict=True):
        if method.name in {m.label for m in results.methods}:
            raise ValueError(f"{spec.text}: expected a label of its own (LABEL={spec.text}), found {method.name} twice")
        width = needed_px(method, m_per_px) - 2 * getattr(method, "margin_px", 0)
        results.methods.append(Method(method.name, spec.text, width * m_per_px))


def _run_condition(
    results: Results, plan: Plan, methods: Sequence[Rival], pairs: PairSource, radius: float, noise: Noise, out: Path
) -> None:
    index = len(results.conditions)
    digest, records = PairsDigest(), []
    scores: list[list[PairScore]] = [[] for _ in methods]
    name = f"D_C {radius:g} m" + "".join(f", {kind}" for kind in noise.kinds)
    for number in trange(len(pairs), desc=name, file=sys.stderr, mininterval=5):
        pair = pairs[number]
        digest.add(pair)
        drawn = number < plan.pictures
        record = PairRecord(pair.name, pair.terrain)
        if drawn:
            record = pictures.store(pair, out, f"pictures/{index}-{number}")
        records.append(record)
        for method, own in zip(methods, scores, strict=True):
            if method.ready:
                own.append(match_one(method, pair, drawn))
    results.conditions.append(Condition(radius, noise, digest.hex(), records))
    for row, method, own in zip(results.methods, methods, scores, strict=True):
        results.cells.append(Cell(row.label, index, own, method.note))


def match_one(method: Rival, pair: Pair, keep_quads: bool = False) -> PairScore:
    """One method on one pair."""
    seen = narrowed(pair, needed_px(method, pair.m_per_px))
    match = method.match(seen)
    found = metrics.score(seen, match.homography, str(match.detail.get("failure", "")))
    quad, coarse = _quads(match, seen) if keep_quads else (None, None)
    return PairScore(found.corner_m, found.centre_m, found.reason, match.seconds, stages_s(match), quad, coarse)


def _quads(match: Match, pair: Pair) -> tuple[Quad | None, Quad | None]:
    found = [quad_of(match, pair), match.coarse if isinstance(match, StagedMatch) else None]
    return tuple(None if q is None or not np.isfinite(q).all() else relative_m(pair, q).round(3).tolist() for q in found)


def machine(device: str = "cpu") -> str:
    """What latencies are of."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    gpu = f"; checkpoints on {torch.cuda.get_device_name(device)}" if device.startswith("cuda") else ""
    return f"{model}, {os.cpu_count()} cores, {torch.get_num_threads()} threads{gpu}"
