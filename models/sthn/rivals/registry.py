"""Every rival by name.

    from sthn import rivals
    for rival in rivals.available(["identity", "sift+ransac", "dhn"], dhn=Path("runs/dhn")):
        match = rival.match(pair)

A path belongs to the rival of its keyword (`-` and `+` written `_`). Rivals without weights come back with
`ready = False` and a note.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from . import classic, learned, loftr, r2d2, retrieval
from .base import Rival, RivalError

Factory = Callable[[Path | None], Rival]


def _learned(key: str) -> Factory:
    return lambda path: learned.load(key, path)


def _classic(detector: str, estimator: str) -> Factory:
    return lambda _path: classic.keypoints(detector, estimator)


FACTORIES: dict[str, Factory] = {
    "identity": lambda _path: classic.Identity(),
    **{f"{d}+{e}": _classic(d, e) for d in classic.DETECTORS for e in classic.ESTIMATORS},
    "r2d2": r2d2.load,
    "loftr": loftr.load,
    **{key: _learned(key) for key in learned.NETWORKS},
    "anyloc": retrieval.load_anyloc,
    "stgl-netvlad": lambda path: retrieval.load_stgl("netvlad", path),
    "stgl-gem": lambda path: retrieval.load_stgl("gem", path),
}
"""Name -> the rival, given the path of its weights or None. In the order of the paper's Table I, then Table II."""


def names() -> list[str]:
    """All rivals, in the order of the tables."""
    return list(FACTORIES)


def keyword(name: str) -> str:
    """The keyword of a rival's path."""
    return name.replace("+", "_").replace("-", "_")


def available(names: Sequence[str] | None = None, **paths: str | Path | None) -> list[Rival]:
    """The rivals of these names (None: all), in the order given. An unknown name or path is an error that lists the
    known ones; a path that does not hold the rival's weights is one that names file and field."""
    wanted = list(FACTORIES) if names is None else list(names)
    if unknown := [name for name in wanted if name not in FACTORIES]:
        raise RivalError(f"rivals: unknown {', '.join(unknown)}; expected {', '.join(FACTORIES)}")
    keywords = {keyword(name) for name in FACTORIES}
    if unknown := sorted(set(paths) - keywords):
        raise RivalError(f"rivals: unknown paths {', '.join(unknown)}; expected {', '.join(sorted(keywords))}")
    found = []
    for name in wanted:
        path = paths.get(keyword(name))
        found.append(FACTORIES[name](None if path is None else Path(path)))
    return found
