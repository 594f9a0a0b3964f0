"""One interface for what is evaluated: checkpoints, bundles and rivals are all `sthn.rivals.base.Rival`.

A method is named `[LABEL=]KIND:WHAT[,OPTION=VALUE ...]`:

    bundle:models/bundles/lite-1536
    "STHN 1536=checkpoint:STHN-two-stages,padding=32"       a released folder: config.json and model.safetensors
    "STHN 512=checkpoint:runs/dc{dc}.pth,window=512,levels=2"  a .pth states neither window nor levels
    checkpoint:mine.pth,window=512,levels=2,lookup=frame_indexed   nor, away from its run, how it looks up (default: as published)
    rival:sift+magsac        rival:dhn@runs/dhn,window=512

`rival:all` is every rival that is not named by itself: all of Tables I and II. `{dc}` in a path becomes the D_C of each
condition: the paper trains a network for each. Options: `window`, `levels`, `padding`, `lookup`, `stages` (1: the coarse
stage alone) of a checkpoint, `stages` of a bundle, `window` of a rival (metres, 512 by default). Networks take pixels: at
another scale than 1 m/px (low flights) the same pixels are another ground.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .. import correlate, geometry, pipeline, rivals
from ..bundle import Bundle, BundleError, read_bundle
from ..checkpoint import load_checkpoint, one_stage
from ..data.pair import FRAME_PX, Pair
from ..network import Lookup, NetworkConfig, Sthn
from ..parity import to_tensor
from ..rivals.base import Match, Rival

RIVAL_WINDOW_M = 512
"""W_S of the rivals in Table I."""

KINDS = ("bundle", "checkpoint", "rival")
OPTIONS = {"bundle": ("stages",), "checkpoint": ("window", "levels", "padding", "stages", "lookup"), "rival": ("window",)}
LOOKUPS = tuple(direction.value for direction in Lookup)


class MethodError(ValueError):
    """A method that cannot be opened. The text names it, the expected and the found."""


@dataclass(frozen=True)
class StagedMatch(Match):
    """A match of a network, with the answer of its first stage."""

    coarse: geometry.Quad | None = None
    """The frame's edges after the coarse stage, window px; None of a one-stage method."""


@dataclass(frozen=True)
class Spec:
    """A method as named on the command line."""

    text: str
    label: str
    kind: str
    what: str
    options: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str) -> Spec:
        """From the grammar above."""
        head, colon, rest = text.partition(":")
        label, equals, kind = head.rpartition("=")
        if not colon or kind not in KINDS:
            raise MethodError(f"method: expected [LABEL=]KIND:WHAT with KIND one of {', '.join(KINDS)}, found {text}")
        what, *given = rest.split(",")
        options: dict[str, Any] = {}
        for word in given:
            name, _, value = word.partition("=")
            if kind == "checkpoint" and name == "lookup":
                if value not in LOOKUPS:
                    raise MethodError(f"{text}: lookup: expected {' | '.join(LOOKUPS)}, found {value}")
                options[name] = Lookup(value)
                continue
            if name not in OPTIONS[kind] or not value.isdecimal():
                raise MethodError(f"{text}: expected {kind} options {', '.join(OPTIONS[kind])} with a number, found {word}")
            options[name] = int(value)
        if not what:
            raise MethodError(f"{text}: expected a path or a name after {kind}:, found nothing")
        return cls(text, label if equals else "", kind, what, options)

    @property
    def by_radius(self) -> bool:
        """Whether each D_C has weights of its own."""
        return "{dc}" in self.what

    def open(self, search_radius_m: float, device: str = "cpu") -> Rival:
        """The method for conditions of this D_C. `device`: of a checkpoint; bundles and rivals run on the CPU."""
        what = self.what.replace("{dc}", f"{search_radius_m:g}")
        stages = self.options.get("stages")
        if stages not in (None, 1, 2):
            raise MethodError(f"{self.text}: stages: expected 1 or 2, found {stages}")
        try:
            if self.kind == "bundle":
                return BundleMethod(read_bundle(what), search_radius_m, stages == 1, self.label)
            if self.kind == "checkpoint":
                return CheckpointMethod(_load(Path(what), self.options), self.label or _name_of(Path(what)), device=device)
            return _rival(what, self.label, self.options)
        except MethodError:
            raise
        except (ValueError, OSError) as error:
            raise MethodError(f"{self.text}: {error}") from error


def parse_all(texts: list[str]) -> list[Spec]:
    """Every method of the command line, `rival:all` as its rivals."""
    specs: list[Spec] = []
    named = {Spec.parse(text).what.partition("@")[0] for text in texts if Spec.parse(text).kind == "rival"}
    for text in texts:
        spec = Spec.parse(text)
        if spec.kind != "rival" or spec.what != "all":
            specs.append(spec)
            continue
        specs += [dataclasses.replace(spec, text=f"rival:{n}", label="", what=n) for n in rivals.names() if n not in named]
    return specs


def needed_px(method: Rival, m_per_px: float = 1.0) -> int:
    """Side of the window that a method wants, px, margin included."""
    if isinstance(method, BundleMethod | CheckpointMethod):
        return method.window_px
    return round((method.window_m or RIVAL_WINDOW_M) / m_per_px)


class CheckpointMethod:
    """The published network in PyTorch."""

    ready = True

    def __init__(self, network: Sthn, name: str, note: str = "", device: str = "cpu") -> None:
        self.network, self.name, self.note, self.device = network.eval().to(device), name, note, device
        self.window_px, self.window_m = network.config.database_size, None

    def match(self, pair: Pair) -> StagedMatch:
        """Eq. (1) to (8), from decoded pixels."""
        config = self.network.config
        _check_sides(self.name, pair, config.database_size, None)
        clock = _StageClock(self.network)
        began = time.perf_counter()
        with clock, torch.inference_mode():
            found = self.network(*(to_tensor(image).to(self.device) for image in (pair.satellite, pair.thermal)))
            final = found.final[0].cpu().double().numpy()
        seconds = time.perf_counter() - began

        def quad(displacement: NDArray) -> geometry.Quad:
            inclusive = geometry.displaced(config.resize_width, displacement)
            return geometry.edges_of_inclusive(inclusive, config.alpha)

        coarse = quad(found.coarse_iterations[-1, 0].cpu().double().numpy()) if found.box is not None else None
        return _answer(pair, quad(final), coarse, seconds, clock.detail())


class BundleMethod:
    """A bundle in ONNX Runtime and numpy: what `src/locate` does, gates apart."""

    ready = True

    def __init__(self, bundle: Bundle, search_radius_m: float | None = None, coarse_only: bool = False, name: str = "") -> None:
        manifest = bundle.manifest
        self.bundle, self.coarse_only = bundle, coarse_only or "refine" not in manifest
        self.name = name or manifest["name"] + (", coarse stage" if coarse_only else "")
        self.search_radius_m = search_radius_m or manifest["search_radius_m"]
        self.margin_px = int(manifest["window_margin_m"])
        self.window_px, self.window_m = int(manifest["window_width_m"]) + 2 * self.margin_px, None
        self.note = ""
        if self.search_radius_m > manifest["search_radius_m"]:
            self.note = f"made for D_C {manifest['search_radius_m']:g} m"

    def match(self, pair: Pair) -> StagedMatch:
        """Coarse, crop, refine. The search disc is that of D_C about the window's middle."""
        _check_sides(self.name, pair, self.window_px, int(self.bundle.manifest["frame_width_m"]))
        manifest, rgb, frame, seen = self.bundle.manifest, pair.satellite, pair.thermal, pair.frame_seen
        detail: dict[str, float | int | str] = {}
        began = time.perf_counter()
        try:
            if manifest["coarse"]["kind"] == "correlation":
                middle = (manifest["window_width_m"] - 1) / 2
                disc = (middle, middle, self.search_radius_m / pair.m_per_px)
                found = correlate.run_coarse(self.bundle, rgb, frame, seen, disc)
                coarse = found.quad
                detail |= found.evidence
            else:
                found, coarse = None, pipeline.run_coarse_matcher(self.bundle, rgb, frame, seen, {})
            between = time.perf_counter()
            quad = coarse
            if not self.coarse_only:
                shape = manifest["refine"]["crop"]["shape"]
                if shape == "oriented" and found is not None:
                    quad, evidence = correlate.run_refine(self.bundle, rgb, frame, seen, found)
                    detail |= evidence
                elif shape == "bounding_box":
                    quad = pipeline.run_refine_bounding_box(self.bundle, rgb, frame, seen, coarse, {})
                else:
                    raise MethodError(f"{self.name}: refine.crop.shape: expected bounding_box, found {shape}")
        except BundleError as error:  # a displacement that is not finite
            return StagedMatch(None, time.perf_counter() - began, {"failure": str(error)})
        ended = time.perf_counter()
        detail["coarse_s"] = between - began
        if not self.coarse_only:
            detail["refine_s"] = ended - between
        rim = self.margin_px
        return _answer(pair, quad + rim, None if self.coarse_only else coarse + rim, ended - began, detail)


def _check_sides(name: str, pair: Pair, window_px: int, frame_px: int | None) -> None:
    """Images of other sides are an error, not a bad answer."""
    if pair.window_m != window_px:
        raise MethodError(f"{name}: pair {pair.name}: expected a window of {window_px} px, found {pair.window_m}")
    if frame_px not in (None, pair.thermal.shape[0]):
        raise MethodError(f"{name}: pair {pair.name}: expected a frame of {frame_px} px, found {pair.thermal.shape[0]}")


def _answer(
    pair: Pair, quad: geometry.Quad, coarse: geometry.Quad | None, seconds: float, detail: dict[str, float | int | str]
) -> StagedMatch:
    """A quad of edges as a match: the DLT is part of the answer."""
    try:
        return StagedMatch(geometry.homography_of_edges(pair.thermal.shape[0], quad), seconds, detail, coarse)
    except ValueError as error:
        return StagedMatch(None, seconds, detail | {"failure": str(error)}, coarse)


class _StageClock:
    """Wall time in each stage's network, by hooks that are gone afterwards."""

    def __init__(self, network: Sthn) -> None:
        self.stages = {"coarse": network.netG} | ({"refine": network.netG_fine} if network.netG_fine is not None else {})
        self.spent: dict[str, float] = {}

    def __enter__(self) -> None:
        self.handles = []
        for name, module in self.stages.items():
            self.handles.append(module.register_forward_pre_hook(lambda *_, n=name: self._start(n)))
            self.handles.append(module.register_forward_hook(lambda *_, n=name: self._stop(n)))

    def _start(self, name: str) -> None:
        self._wait()
        self.spent[name] = -time.perf_counter()

    def _stop(self, name: str) -> None:
        self._wait()
        self.spent[name] += time.perf_counter()

    def _wait(self) -> None:
        """A GPU works on after it was asked."""
        device = next(self.stages["coarse"].parameters()).device
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    def __exit__(self, *_: object) -> None:
        for handle in self.handles:
            handle.remove()

    def detail(self) -> dict[str, float | int | str]:
        return {f"{name}_s": seconds for name, seconds in self.spent.items()}


def stages_s(match: Match) -> dict[str, float]:
    """Seconds of each stage, where a method says them: the details that end in `_s`."""
    return {k.removesuffix("_s"): float(v) for k, v in match.detail.items() if k.endswith("_s") and not isinstance(v, str)}


def _load(path: Path, options: dict[str, Any]) -> Sthn:
    changes = {
        "database_size": options.get("window"),
        "corr_level": options.get("levels"),
        "fine_padding": options.get("padding"),
    }
    given = {name: value for name, value in changes.items() if value is not None}
    if path.is_dir():
        config = dataclasses.replace(NetworkConfig.read(path / "config.json"), **given)
    else:
        if missing := [name for name, key in (("window", "database_size"), ("levels", "corr_level")) if key not in given]:
            raise MethodError(f"{path}: a .pth file states no configuration: expected {', '.join(missing)}=N, found none")
        document = torch.load(path, map_location="cpu", weights_only=True)
        two = isinstance(document, dict) and document.get("netG_fine") is not None
        config = NetworkConfig(resize_width=256, iters_lev0=6, iters_lev1=6, two_stages=two, **({"fine_padding": 32} | given))
    network = load_checkpoint(path, config, lookup=options.get("lookup"))
    if options.get("stages") == 2 and network.netG_fine is None:
        raise MethodError(f"{path}: stages: expected a fine network (netG_fine), found none")
    return one_stage(network) if options.get("stages") == 1 else network


def _name_of(path: Path) -> str:
    return path.stem if path.suffix == ".pth" else path.name


@dataclass
class _Renamed:
    """A rival under the caller's label, at a given W_S."""

    rival: Rival
    name: str
    window_m: int | None

    @property
    def note(self) -> str:
        return self.rival.note

    @property
    def ready(self) -> bool:
        return self.rival.ready

    def match(self, pair: Pair) -> Match:
        return self.rival.match(pair)


def _rival(what: str, label: str, options: dict[str, Any]) -> Rival:
    name, _, path = what.partition("@")
    paths = {rivals.registry.keyword(name): path} if path else {}
    (rival,) = rivals.available([name], **paths)
    window = options.get("window", rival.window_m or RIVAL_WINDOW_M)
    if rival.window_m not in (None, window):
        raise MethodError(f"rival:{what}: window: expected {rival.window_m}, found {window}")
    if window < FRAME_PX:
        raise MethodError(f"rival:{what}: window: expected at least {FRAME_PX}, found {window}")
    return _Renamed(rival, label or rival.name, window)


def quad_of(match: Match, pair: Pair) -> geometry.Quad | None:
    """The frame's edges where the match puts them, window px; None without an answer or where it is not finite."""
    if match.homography is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        quad = geometry.apply(match.homography, geometry.edge_corners(pair.thermal.shape[0]))
    return quad if np.isfinite(quad).all() else None
