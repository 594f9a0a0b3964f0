"""A source from a table of a TOML file. Unknown keys are errors.

    kind = "boson"                    # the published HDF5 layout
    folder = "datasets/..."           # with {split}_queries.h5 and {split}_database.h5
    split = "train"
    window_m = 1536
    search_radius_m = 512             # D_C
    # seed = 0, map = "MAP.png", pairs = "pairs.json", allow_test_region = false, count = 1000 (at most so many)

    kind = "maps"                     # maps alone, thermal synthesised
    maps = ["A.tif", "B.tif"]         # or one folder
    count = 1000                      # pairs a pass
    # seed, m_per_px = 1.0, frame_px = 512, augment = false, surround (set where there is noise), style

    kind = "flight"                   # a recorded flight with truth
    folder = "flights/a"
    map = "A.tif"
    # seed, m_per_px, own_priors = false, surround (set where there is noise), count

`window_m` is W_S in pixels of `m_per_px`. Any kind may have `noise = { rotation_deg, scale, perspective_px, kind }`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..lite import scene
from . import boson
from .errors import DataError
from .flight import RecordedFlight
from .georeferenced import FlightPairs, MapPairs
from .noise import Noisy, Seed
from .pair import Noise, Pair, PairSource

COMMON = {"kind": str, "window_m": int, "search_radius_m": float, "seed": int, "count": int, "noise": Mapping, "name": str}
KEYS: dict[str, dict[str, type]] = {
    "boson": {"folder": str, "split": str, "map": str, "pairs": str, "allow_test_region": bool},
    "maps": {"maps": list, "m_per_px": float, "frame_px": int, "augment": bool, "surround": bool, "style": int},
    "flight": {"folder": str, "map": str, "m_per_px": float, "own_priors": bool, "surround": bool},
}
NOISE_KEYS = {"rotation_deg": float, "scale": float, "perspective_px": float, "kind": str}


class Part:
    """Some of a source's pairs, spread evenly over it: the same ones in every run."""

    def __init__(self, source: PairSource, count: int) -> None:
        self.source, self.count = source, min(count, len(source))
        self.name, self.window_m, self.search_radius_m = source.name, source.window_m, source.search_radius_m

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Pair:
        if not 0 <= index < self.count:
            raise IndexError(index)
        return self.source[index * len(self.source) // self.count]

    def reseeded(self, seed: Seed) -> Part:
        """The same part of the source with other draws."""
        return Part(self.source.reseeded(seed), self.count)


def check(table: Mapping[str, Any], keys: Mapping[str, type], where: str) -> None:
    """Every key known and of its type; a whole number is a float too."""
    for key, value in table.items():
        if key not in keys:
            raise DataError(where, key, f"one of {', '.join(sorted(keys))}", "an unknown key")
        wanted = keys[key]
        fits = isinstance(value, (int, float)) if wanted is float else isinstance(value, wanted)
        if not fits or (isinstance(value, bool) and wanted is not bool):
            raise DataError(where, key, wanted.__name__, repr(value))


def open_source(
    spec: Mapping[str, Any], where: str = "source", root: Path = Path("."), purpose: boson.Purpose = "evaluate"
) -> PairSource:
    """Opens what a table describes. Paths are relative to `root`; `where` names the table in errors.

    `purpose = "train"` refuses the extended set that holds the test region.
    """
    kind = spec.get("kind")
    if kind not in KEYS:
        raise DataError(where, "kind", " | ".join(KEYS), repr(kind))
    check(spec, COMMON | KEYS[kind], where)
    for key in ("window_m", "search_radius_m"):
        if key not in spec:
            raise DataError(where, key, "a number", "nothing")
    noise, kind_of_noise = _noise(spec.get("noise", {}), f"{where}.noise")
    source = {"boson": _boson, "maps": _maps, "flight": _flight}[kind](spec, where, root, purpose, bool(noise.kinds))
    if "name" in spec:
        source.name = spec["name"]
    if "count" in spec and kind != "maps":
        source = Part(source, spec["count"])
    return Noisy(source, noise, spec.get("seed", 0), kind_of_noise) if noise.kinds else source


def _noise(table: Mapping[str, Any], where: str) -> tuple[Noise, Any]:
    check(table, NOISE_KEYS, where)
    noise = Noise(**{key: float(value) for key, value in table.items() if key != "kind"})
    for key, value in (("rotation_deg", noise.rotation_deg), ("scale", noise.scale), ("perspective_px", noise.perspective_px)):
        if not 0 <= value < {"rotation_deg": 180, "scale": 1, "perspective_px": 64}[key]:
            raise DataError(where, key, "a bound from 0 (under 180 degrees, 1, or 64 px)", value)
    kind = table.get("kind")
    if kind not in (None, "none", *noise.kinds):
        raise DataError(where, "kind", f"none or a kind with a bound above 0 ({', '.join(noise.kinds) or 'there is none'})", kind)
    return noise, kind


def _need(spec: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in spec:
        raise DataError(where, key, "a value", "nothing")
    return spec[key]


def _boson(spec: Mapping[str, Any], where: str, root: Path, purpose: boson.Purpose, noisy: bool) -> PairSource:
    return boson.open_split(
        root / _need(spec, "folder", where),
        _need(spec, "split", where),
        spec["window_m"],
        spec["search_radius_m"],
        spec.get("seed", 0),
        root / spec["map"] if "map" in spec else None,
        purpose,
        spec.get("allow_test_region", False),
        root / spec["pairs"] if "pairs" in spec else None,
    )


def _maps(spec: Mapping[str, Any], where: str, root: Path, purpose: boson.Purpose, noisy: bool) -> PairSource:
    paths = []
    for name in _need(spec, "maps", where):
        path = root / name
        paths += sorted(p for p in path.glob("*.tif") if not p.stem.endswith("_classes")) if path.is_dir() else [path]
    if missing := [path for path in paths if not path.is_file()]:
        raise DataError(where, "maps", "files that are there", missing[0])
    return MapPairs(
        [scene.load_map(path) for path in paths],
        spec["window_m"],
        spec["search_radius_m"],
        _need(spec, "count", where),
        spec.get("seed", 0),
        float(spec.get("m_per_px", 1.0)),
        spec.get("frame_px", 512),
        spec.get("augment", False),
        spec.get("surround", noisy),
        spec.get("name", "maps"),
        spec.get("style"),
    )


def _flight(spec: Mapping[str, Any], where: str, root: Path, purpose: boson.Purpose, noisy: bool) -> PairSource:
    return FlightPairs(
        RecordedFlight.open(root / _need(spec, "folder", where)),
        root / _need(spec, "map", where),
        spec["window_m"],
        spec["search_radius_m"],
        spec.get("seed", 0),
        float(spec.get("m_per_px", 1.0)),
        spec.get("own_priors", False),
        spec.get("surround", noisy),
    )
