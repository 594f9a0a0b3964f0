"""`bundle.toml`: its fields, its rules, its text. The same as `src/model/manifest.rs` and `validate.rs`: what passes here
opens there.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

SCHEMA = 1
TONE_MAPPING = 1
"""Version of the 16-to-8-bit mapping (`src/thermal/tone.rs`)."""

MAX_INPUT_PX = 4096
MAX_WIDTH_M = 8192.0
MAX_CELLS = 1024
MAX_HYPOTHESES = 4096

CONTENT_CHANNELS = {"rgb": 3, "gray": 1, "gray_thrice": 3, "gray_mask": 2}
RESIZE = ("half_pixel_antialias", "align_corners_antialias", "align_corners_bilinear", "supersample")
LOOKUP = ("published", "map_indexed", "frame_indexed")
CROP = ("bounding_box", "oriented")
GRAYS = ("gray", "gray_thrice", "gray_mask")
WHOLE = ("half_pixel_antialias", "align_corners_antialias")


class ManifestError(ValueError):
    """A field that is missing, unknown or not what it must be. The text names field, expected and found."""

    def __init__(self, field: str, expected: str, found: object) -> None:
        super().__init__(f"{field}: expected {expected}, found {found!r}")


Check = Callable[[str, Any], None]


def _number(path: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ManifestError(path, "a finite number", value)


def _count(path: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ManifestError(path, "a whole number of at least 0", value)


def _text(path: str, value: Any) -> None:
    if not isinstance(value, str) or not 1 <= len(value.encode()) <= 4096 or "\0" in value:
        raise ManifestError(path, "a text of 1 to 4096 characters", value)


def _choice(*names: str) -> Check:
    def check(path: str, value: Any) -> None:
        if value not in names:
            raise ManifestError(path, f"one of {', '.join(names)}", value)

    return check


def _list(item: Check) -> Check:
    def check(path: str, value: Any) -> None:
        if not isinstance(value, list):
            raise ManifestError(path, "a list", value)
        for i, element in enumerate(value):
            item(f"{path}[{i}]", element)

    return check


def _table(required: dict[str, Check], optional: dict[str, Check] | None = None) -> Check:
    known = required | (optional or {})

    def check(path: str, value: Any) -> None:
        if not isinstance(value, dict):
            raise ManifestError(path, "a table", value)
        prefix = f"{path}." if path else ""
        for name in required:
            if name not in value:
                raise ManifestError(f"{prefix}{name}", "a value", "nothing")
        for name, element in value.items():
            if name not in known:
                raise ManifestError(f"{prefix}{name}", f"one of {', '.join(known)}", name)
            known[name](f"{prefix}{name}", element)

    return check


def _file(path: str, value: Any) -> None:
    _table({"file": _text, "sha256": _text})(path, value)
    name, digest = value["file"], value["sha256"]
    if name.startswith(".") or any(c in name for c in "/\\:") or len(name) > 255:
        raise ManifestError(f"{path}.file", "a file name without separators", name)
    if len(digest) != 64 or any(c not in "0123456789abcdef" for c in digest):
        raise ManifestError(f"{path}.sha256", "64 lower-case hex digits", digest)


_INPUT = _table({"size_px": _count, "width_m": _number, "content": _choice(*CONTENT_CHANNELS), "resize": _choice(*RESIZE)})

_COMMON = {"kind": _choice("matcher", "correlation"), "map_graph": _file, "graph": _file, "map": _INPUT, "frame": _INPUT}

_MATCHER = _table(
    _COMMON | {"lookup": _choice(*LOOKUP), "tolerance_px": _number, "match_sigma_m": _number},
    {"crop": _table({"shape": _choice(*CROP), "padding_m": _number})},
)

_CORRELATION = _table(
    _COMMON
    | {
        "stride": _count,
        "rotations_deg": _list(_number),
        "scales": _list(_number),
        "subcell_radius": _count,
        "tolerance": _number,
        "match_sigma_m": _number,
    }
)


def _stage(path: str, value: Any) -> None:
    kind = value.get("kind") if isinstance(value, dict) else None
    _choice("matcher", "correlation")(f"{path}.kind", kind)
    (_MATCHER if kind == "matcher" else _CORRELATION)(path, value)


_INTEGRITY = _table(
    {
        "data": _text,
        "command": _text,
        "trials": _count,
        "bound_m": _number,
        "bias": _number,
        "cues": _list(
            _table(
                {
                    "name": _text,
                    "transform": _choice("linear", "log", "logit"),
                    "low": _number,
                    "high": _number,
                    "weight": _number,
                    "sigma_weight": _number,
                }
            )
        ),
        "probability": _table({"scores": _list(_number), "p": _list(_number)}),
        "sigma": _table({"bias": _number, "least_m": _number, "most_m": _number, "tail999": _number}),
    }
)

_MANIFEST = _table(
    {
        "schema": _count,
        "name": _text,
        "licence": _text,
        "window_width_m": _number,
        "window_margin_m": _number,
        "frame_width_m": _number,
        "m_per_px": _number,
        "search_radius_m": _number,
        "tone_mapping": _count,
        "opset": _count,
        "provenance": _table({"description": _text, "command": _text, "data": _list(_text)}, {"seed": _count}),
        "golden": _file,
        "coarse": _stage,
    },
    {
        "refine": _stage,
        "scale_range": _list(_number),
        "integrity": _INTEGRITY,
        "accuracy": _table(
            {
                "data": _text,
                "command": _text,
                "frames": _count,
                "search_radius_m": _number,
                "coverage": _number,
                "median_m": _number,
                "mean_m": _number,
                "p95_m": _number,
                "over_25m": _number,
                "over_50m": _number,
            }
        ),
    },
)


def check(manifest: dict[str, Any]) -> None:
    """Raises [`ManifestError`] at the first field that is not what it must be."""
    _MANIFEST("", manifest)
    _equal("schema", manifest["schema"], SCHEMA)
    _equal("tone_mapping", manifest["tone_mapping"], TONE_MAPPING)
    _equal("m_per_px", manifest["m_per_px"], 1.0)
    _within("window_width_m", manifest["window_width_m"], 64, MAX_WIDTH_M)
    _within("window_margin_m", manifest["window_margin_m"], 0, 1024)
    _within("frame_width_m", manifest["frame_width_m"], 64, manifest["window_width_m"])
    for name in ("window_width_m", "window_margin_m", "frame_width_m"):
        if manifest[name] != int(manifest[name]):
            raise ManifestError(name, "a whole number of metres", manifest[name])
    _within("search_radius_m", manifest["search_radius_m"], 1, manifest["window_width_m"])
    if manifest["coarse"]["kind"] == "matcher":
        _check_matcher(manifest, "coarse", manifest["coarse"])
    else:
        _check_correlation(manifest, manifest["coarse"])
    if (refine := manifest.get("refine")) is not None:
        if refine["kind"] != "matcher":
            raise ManifestError("refine.kind", "matcher", refine["kind"])
        _check_matcher(manifest, "refine", refine)
    if (scales := manifest.get("scale_range")) is not None:
        if len(scales) != 2:
            raise ManifestError("scale_range", "two numbers", scales)
        _within("scale_range[0]", scales[0], 0.01, 1)
        _within("scale_range[1]", scales[1], 1, 100)
    if (integrity := manifest.get("integrity")) is not None:
        _check_integrity(integrity)


def _check_integrity(table: dict[str, Any]) -> None:
    _within("integrity.bound_m", table["bound_m"], 1, 1e4)
    if not 1 <= len(table["cues"]) <= 64:
        raise ManifestError("integrity.cues", "1 to 64", len(table["cues"]))
    for i, cue in enumerate(table["cues"]):
        if cue["low"] > cue["high"]:
            raise ManifestError(f"integrity.cues[{i}]", "low <= high", cue)
    scores, p = table["probability"]["scores"], table["probability"]["p"]
    rising = all(a < b for a, b in pairwise(scores)) and all(a <= b for a, b in pairwise(p))
    if len(scores) != len(p) or not 1 <= len(p) <= 256 or not rising or not all(0 <= x <= 1 for x in p):
        raise ManifestError("integrity.probability", "1 to 256 rising scores with as many probabilities that do not fall", p)
    sigma = table["sigma"]
    _within("integrity.sigma.least_m", sigma["least_m"], 1e-3, sigma["most_m"])
    _within("integrity.sigma.most_m", sigma["most_m"], sigma["least_m"], 1e4)
    _within("integrity.sigma.tail999", sigma["tail999"], 3.7169 - 1e-3, 1e3)


def _equal(path: str, value: float, expected: float, what: str = "") -> None:
    if abs(value - expected) > 1e-6 * max(1.0, abs(expected)):
        raise ManifestError(path, f"{expected}{what}", value)


def _within(path: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ManifestError(path, f"{low} to {high}", value)


def _check_input(path: str, spec: dict[str, Any], contents: tuple[str, ...], rules: tuple[str, ...]) -> None:
    _within(f"{path}.size_px", spec["size_px"], 8, MAX_INPUT_PX)
    _within(f"{path}.width_m", spec["width_m"], 1, MAX_WIDTH_M)
    _choice(*contents)(f"{path}.content", spec["content"])
    _choice(*rules)(f"{path}.resize", spec["resize"])


def _check_matcher(manifest: dict[str, Any], name: str, stage: dict[str, Any]) -> None:
    _check_input(f"{name}.frame", stage["frame"], GRAYS, WHOLE)
    _equal(f"{name}.frame.width_m", stage["frame"]["width_m"], manifest["frame_width_m"], " (frame_width_m)")
    _within(f"{name}.tolerance_px", stage["tolerance_px"], 1e-9, 1)
    _within(f"{name}.match_sigma_m", stage["match_sigma_m"], 1e-3, 1e4)
    crop = stage.get("crop")
    if name == "coarse":
        if crop is not None:
            raise ManifestError("coarse.crop", "none: a coarse stage sees the window", crop)
        _check_input("coarse.map", stage["map"], ("rgb",), WHOLE)
        _equal("coarse.map.width_m", stage["map"]["width_m"], manifest["window_width_m"], " (window_width_m)")
        return
    if crop is None:
        raise ManifestError(f"{name}.crop", "a crop", "nothing")
    _within(f"{name}.crop.padding_m", crop["padding_m"], 0, MAX_WIDTH_M)
    rule = "align_corners_bilinear" if crop["shape"] == "bounding_box" else "supersample"
    _check_input(f"{name}.map", stage["map"], ("rgb",), (rule,))
    if crop["shape"] == "oriented":
        side_m = manifest["frame_width_m"] + 2 * crop["padding_m"]
        _equal(f"{name}.map.width_m", stage["map"]["width_m"], side_m, " (frame_width_m + 2 padding_m)")


def _check_correlation(manifest: dict[str, Any], stage: dict[str, Any]) -> None:
    _check_input("coarse.map", stage["map"], ("rgb",), WHOLE)
    _check_input("coarse.frame", stage["frame"], GRAYS, ("half_pixel_antialias",))
    covered_m = manifest["window_width_m"] + 2 * manifest["window_margin_m"]
    _equal("coarse.map.width_m", stage["map"]["width_m"], covered_m, " (window_width_m + 2 window_margin_m)")
    _equal("coarse.frame.width_m", stage["frame"]["width_m"], manifest["frame_width_m"], " (frame_width_m)")
    map_scale, frame_scale = (stage[name]["width_m"] / stage[name]["size_px"] for name in ("map", "frame"))
    _equal("coarse.frame.size_px", frame_scale, map_scale, " metres per pixel, as coarse.map has")
    stride, sizes = stage["stride"], [stage["map"]["size_px"], stage["frame"]["size_px"]]
    if not 1 <= stride <= 32 or any(size % stride for size in sizes):
        raise ManifestError("coarse.stride", "1 to 32 and a divisor of both inputs' size_px", stride)
    if sizes[0] // stride > MAX_CELLS or sizes[1] > sizes[0]:
        raise ManifestError("coarse.map.size_px", f"at most {MAX_CELLS} strides, at least coarse.frame's", sizes[0])
    hypotheses = len(stage["rotations_deg"]) * len(stage["scales"])
    if not 1 <= hypotheses <= MAX_HYPOTHESES:
        raise ManifestError("coarse.rotations_deg x coarse.scales", f"1 to {MAX_HYPOTHESES} hypotheses", hypotheses)
    for turn in stage["rotations_deg"]:
        _within("coarse.rotations_deg", turn, -180, 180)
    for scale in stage["scales"]:
        _within("coarse.scales", scale, 0.25, 4)
    _within("coarse.subcell_radius", stage["subcell_radius"], 0, 8)
    _within("coarse.tolerance", stage["tolerance"], 1e-9, 1)
    _within("coarse.match_sigma_m", stage["match_sigma_m"], 1e-3, 1e4)


COMMENTS = {
    "window_width_m": "W_S: side of the search window",
    "window_margin_m": "map read beyond the window on each side",
    "frame_width_m": "side of the frame's square of ground",
    "m_per_px": "of window and rectified frame",
    "search_radius_m": "D_C: largest distance of the frame's centre from the window's",
    "tone_mapping": "version of the 16-to-8-bit mapping the weights were trained with",
    "lookup": "direction of the correlation look-up; weights belong to theirs",
    "tolerance_px": "largest difference from the golden outputs, pixels of the stage's map input",
    "tolerance": "largest difference from the golden outputs, relative to their largest",
    "match_sigma_m": "1-sigma per axis of the match error on validation",
    "stride": "input pixels per feature cell",
    "rotations_deg": "yaw hypotheses: true yaw minus assumed yaw",
    "scales": "scale hypotheses: true footprint over assumed",
    "subcell_radius": "cells round the peak of the sub-cell soft-argmax",
    "padding_m": "added on each side of the square",
    "scale_range": "frame, window and D_C may be scaled together by this, the pixels staying as many",
    "bound_m": "an error above this counts as a wrong place",
    "tail999": "radius of probability 0.999, in sigmas",
}
"""What stands beside a field in the written file."""


ORDER = (
    *("schema", "name", "licence", "window_width_m", "window_margin_m", "frame_width_m", "m_per_px", "search_radius_m"),
    *("scale_range", "tone_mapping", "opset", "golden", "provenance", "accuracy", "coarse", "refine", "integrity"),
    *("kind", "map_graph", "graph", "lookup", "stride", "rotations_deg", "scales", "subcell_radius"),
    *("tolerance_px", "tolerance", "match_sigma_m", "map", "frame", "crop"),
)
"""Order of the fields in the written file."""


def ordered(table: dict[str, Any]) -> dict[str, Any]:
    """The same table with its fields in the order of the file; inner tables too."""
    place = {name: i for i, name in enumerate(ORDER)}
    names = sorted(table, key=lambda name: place.get(name, len(place)))
    return {name: ordered(value) if isinstance(value := table[name], dict) else value for name in names}


def to_toml(manifest: dict[str, Any]) -> str:
    """The text of a checked manifest, with a comment where a name does not say it all. Reading it gives the same."""
    lines = ["# A nightfix model bundle. Every number needed to feed its graphs stands here; files are checked by digest.", ""]
    _write_table(lines, "", manifest)
    text = "\n".join(lines).rstrip() + "\n"
    if tomllib.loads(text) != manifest:
        raise ManifestError("bundle.toml", "a text that reads back as the manifest", text)
    return text


def put(bundle: Path, **tables: Any) -> None:
    """Replaces fields or tables of a bundle's `bundle.toml`, checked as ever; the graphs stay."""
    path = bundle / "bundle.toml"
    manifest = tomllib.loads(path.read_text()) | tables
    check(manifest)
    path.write_text(to_toml(ordered(manifest)))


def _write_table(lines: list[str], path: str, table: dict[str, Any]) -> None:
    inner = {name: value for name, value in table.items() if isinstance(value, dict) and set(value) != {"file", "sha256"}}
    for name, value in table.items():
        if name not in inner:
            comment = f"  # {COMMENTS[name]}" if name in COMMENTS else ""
            lines.append(f"{name} = {_value(value)}{comment}")
    for name, value in inner.items():
        lines.extend(["", f"[{path}{name}]"])
        _write_table(lines, f"{path}{name}.", value)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # A JSON string is a TOML basic string, but for DEL, which JSON leaves as it is.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_value(inner)}" for name, inner in value.items()) + " }"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + "".join(f"    {_value(element)},\n" for element in value) + "]"
    if isinstance(value, list):
        return "[" + ", ".join(_value(element) for element in value) + "]"
    return repr(value)
