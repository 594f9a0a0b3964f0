"""`python -m sthn.export CHECKPOINT --out DIR --name N`: a released checkpoint -> a model bundle.

Per stage two graphs: the map encoder (so that a window's features can be kept) and the matcher with the frame's encoder,
with look-ups as gathers and a free number of frames. What is written is checked: graphs against torch to 1e-3 px, the
numpy pipeline against the network end to end; the command fails otherwise.

    python -m sthn.export STHN-two-stages --out bundles/sthn --name sthn-1536 --padding 32
    python -m sthn.export STHN.pth --window 1536 --levels 4 --out bundles/sthn --name sthn-1536
    python -m sthn.export --random-weights 1 --out target/random-1536 --name random-1536
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import io
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from . import pipeline, procedural
from .bundle import Bundle, BundleError, golden_arrays, in_memory, write_bundle
from .checkpoint import load_checkpoint, one_stage, read_experiment, stated_lookup
from .network import Lookup, Matcher, NetworkConfig, Sthn
from .parity import to_tensor

OPSET = 17
"""GroupNorm and InstanceNorm are plain nodes in it, and nothing needs a later one."""

EXPORT_TOLERANCE_PX = 1e-3
"""Torch against ONNX Runtime here: every displacement of every iteration."""

RUN_TOLERANCE_PX = 5e-3
"""Golden pair on another machine or execution provider: another order of the same sums."""

END_TO_END_TOLERANCE_PX = 1e-2
"""The numpy pipeline against torch: its inputs differ in the last bits, and the fine stage amplifies them."""

FRAME_WIDTH_M = 512
PAPER_LEVELS = {512: 2, 1024: 4, 1536: 4}
PAPER_SIGMA_M = {"coarse": 12.7, "refine": 9.7}
"""Table II: mean centre error 15.90 and 12.12 m at W_S = 1536, over 1.253 (Rayleigh) per axis."""

RAYLEIGH = 1.253
"""Mean distance in the plane over the 1-sigma of an axis."""


class MapEncoder(nn.Module):
    """`map` `[1, 3, R, R]` in 0..1 -> `map_features`."""

    def __init__(self, matcher: Matcher) -> None:
        super().__init__()
        self.matcher = matcher

    def forward(self, image: Tensor) -> Tensor:
        return self.matcher.encode(image)


class FrameMatcher(nn.Module):
    """`map_features` `[1, C, h, w]`, `frame` `[B, 3, R, R]` -> `displacement` `[B, 2, 2, 2]`, `iterations` `[K, B, 2, 2, 2]`."""

    def __init__(self, matcher: Matcher) -> None:
        super().__init__()
        self.matcher = matcher

    def forward(self, map_features: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        iterations = self.matcher.match(map_features, self.matcher.encode(frame))
        return iterations[-1], iterations


def to_onnx(module: nn.Module, examples: dict[str, Tensor], outputs: list[str], dynamic: dict[str, dict[int, str]]) -> bytes:
    """One graph. Examples must be distinct tensors: an exporter may take one object given twice for one input."""
    if len({tensor.data_ptr() for tensor in examples.values()}) != len(examples):
        raise BundleError("export: expected distinct example tensors, found the same one twice")
    buffer = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        # The tracing exporter: a tenth of the other's time, and the graph is the same arithmetic.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module.eval(),
            tuple(examples.values()),
            buffer,
            input_names=list(examples),
            output_names=outputs,
            dynamic_axes=dynamic,
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    if "GridSample" in {node.op_type for node in model.graph.node}:
        raise BundleError("export: expected look-ups as gathers, found GridSample")
    model.producer_name, model.producer_version = "sthn", ""
    return model.SerializeToString()


def export_matcher(matcher: Matcher, resize_width: int) -> tuple[bytes, bytes]:
    """Map encoder and matcher of one stage, each checked against torch on several frames at once."""
    generator = torch.Generator().manual_seed(0)
    image, *frames = torch.rand(3, 3, resize_width, resize_width, generator=generator)
    image, frames = image[None].clone(), torch.stack(frames)
    with torch.inference_mode():
        features = matcher.encode(image)
        expected = matcher.match(features, matcher.encode(frames))
    encoder = to_onnx(MapEncoder(matcher), {"map": image}, ["map_features"], {})
    graph = to_onnx(
        FrameMatcher(matcher),
        {"map_features": features.clone(), "frame": frames.clone()},
        ["displacement", "iterations"],
        {"frame": {0: "batch"}, "displacement": {0: "batch"}, "iterations": {1: "batch"}},
    )
    _check_batches(encoder, graph, image, frames, expected)
    return encoder, graph


def _check_batches(encoder: bytes, graph: bytes, image: Tensor, frames: Tensor, expected: Tensor) -> None:
    """One map, one and two frames: the golden pair alone would not show a graph that is fixed to its example."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    sessions = [onnxruntime.InferenceSession(g, options, providers=["CPUExecutionProvider"]) for g in (encoder, graph)]
    features = sessions[0].run(None, {"map": image.numpy()})[0]
    for count in (1, len(frames)):
        found = sessions[1].run(["displacement", "iterations"], {"map_features": features, "frame": frames[:count].numpy()})
        wanted = expected[:, :count].numpy()
        if found[1].shape != wanted.shape or found[0].shape != wanted.shape[1:]:
            raise BundleError(f"export: {count} frames: expected {wanted.shape}, found {found[1].shape} and {found[0].shape}")
        difference = max(float(np.abs(found[1] - wanted).max()), float(np.abs(found[0] - wanted[-1]).max()))
        if not difference <= EXPORT_TOLERANCE_PX:
            raise BundleError(
                f"export: {count} frames: expected {EXPORT_TOLERANCE_PX} px from torch at most, found {difference:.3g}"
            )


def manifest_of(
    network: Sthn, name: str, licence: str, provenance: dict[str, Any], search_radius_m: float, sigma_m: dict[str, float]
) -> dict[str, Any]:
    """The manifest of a published network's bundle, as [`write_bundle`] wants it."""
    config = network.config
    size, window = config.resize_width, float(config.database_size)

    def stage(key: str, width_m: float, resize: str) -> dict[str, Any]:
        return {
            "kind": "matcher",
            "lookup": network.netG.lookup.value,
            "tolerance_px": RUN_TOLERANCE_PX,
            "match_sigma_m": sigma_m[key],
            "map": {"size_px": size, "width_m": width_m, "content": "rgb", "resize": resize},
            "frame": {
                "size_px": size,
                "width_m": float(FRAME_WIDTH_M),
                "content": "gray_thrice",
                "resize": "half_pixel_antialias",
            },
        }

    manifest = {
        "schema": 1,
        "name": name,
        "licence": licence,
        "provenance": provenance,
        "window_width_m": window,
        "window_margin_m": 0.0,  # the published crop sees nothing beyond the window
        "frame_width_m": float(FRAME_WIDTH_M),
        "m_per_px": 1.0,
        "search_radius_m": search_radius_m,
        "tone_mapping": 1,
        "opset": OPSET,
        "coarse": stage("coarse", window, "align_corners_antialias"),
    }
    if config.two_stages:
        padding = float(config.fine_padding)
        refine = stage("refine", FRAME_WIDTH_M + 2 * padding, "align_corners_bilinear")
        manifest["refine"] = refine | {"crop": {"shape": "bounding_box", "padding_m": padding}}
    return manifest


def graphs_of(network: Sthn) -> dict[str, bytes]:
    """Every graph of a network, checked."""
    graphs = {}
    for stage, matcher in (("coarse", network.netG), ("refine", network.netG_fine)):
        if matcher is not None:
            graphs[f"{stage}_map"], graphs[stage] = export_matcher(matcher, network.config.resize_width)
    return graphs


def golden_of(network: Sthn, bundle: Bundle) -> dict[str, NDArray[Any]]:
    """The golden pair: torch's outputs for what the pipeline feeds each graph on a procedural pair.

    Map features are stored to 2^-10 (so that they deflate to half their size), and torch matches with what is stored.
    """
    window = procedural.blocks(network.config.database_size)
    frame = procedural.frame_of(window)
    match = pipeline.match_pair(bundle, window, frame)
    with torch.inference_mode():
        expected = network(to_tensor(window), to_tensor(frame)).final[0].double().numpy()
    difference = float(np.abs(match.final - expected).max())
    if not difference <= END_TO_END_TOLERANCE_PX:
        raise BundleError(f"final: expected {END_TO_END_TOLERANCE_PX} px from torch at most, found {difference:.3g}")
    inputs, outputs = {}, {}
    for stage, matcher in (("coarse", network.netG), ("refine", network.netG_fine)):
        if matcher is None:
            continue
        image, thermal = (torch.from_numpy(match.inputs[g][p]) for g, p in ((f"{stage}_map", "map"), (stage, "frame")))
        with torch.inference_mode():
            features = torch.round(matcher.encode(image) * 2**10) / 2**10
            displacement, iterations = FrameMatcher(matcher)(features, thermal)
        inputs |= {f"{stage}_map": {"map": image}, stage: {"frame": thermal}}
        outputs |= {f"{stage}_map": {"map_features": features}, stage: {"displacement": displacement, "iterations": iterations}}
    arrays = golden_arrays(inputs, outputs)
    return arrays | {"map_rgb": window, "frame": frame, "final": match.final, "homography": match.homography}


def export(
    network: Sthn,
    folder: Path,
    name: str,
    licence: str,
    provenance: dict[str, Any],
    search_radius_m: float,
    sigma_m: dict[str, float],
) -> dict[str, float]:
    """A network -> a bundle in `folder`; returns the largest difference of every golden output, at most 1e-3 px."""
    manifest = manifest_of(network, name, licence, provenance, search_radius_m, sigma_m)
    graphs = graphs_of(network)
    golden = golden_of(network, in_memory(manifest, graphs))
    return write_bundle(folder, manifest, graphs, golden, tolerance_px=EXPORT_TOLERANCE_PX)


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sthn.export", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path, nargs="?", help="directory with config.json and model.safetensors, or a .pth")
    parser.add_argument("--out", type=Path, required=True, help="the bundle's folder")
    parser.add_argument("--name", required=True, help="the bundle's name, in every fix message")
    parser.add_argument(
        "--random-weights", type=int, metavar="SEED", help="the published architecture with weights made by formula"
    )
    parser.add_argument("--one-stage", action="store_true", help="the coarse stage alone")
    parser.add_argument("--fine", type=Path, help="a second .pth whose netG is the fine network")
    parser.add_argument("--padding", type=int, help="on each side of the coarse box, m (default: the config's; 32 where none)")
    parser.add_argument("--window", type=int, help="W_S, m (default: the config's; 1536 where none)")
    parser.add_argument("--levels", type=int, help="correlation levels of the coarse stage; must be given for a .pth")
    lookups = [direction.value for direction in Lookup]
    parser.add_argument("--lookup", choices=lookups, help="that the weights were trained with, where the checkpoint states none")
    parser.add_argument("--search-radius-m", type=float, help="D_C (default: the training's; else (W_S - 512) / 2, at least 50)")
    parser.add_argument("--coarse-sigma-m", type=float, help="1-sigma per axis (default: the training's validation; the paper's)")
    parser.add_argument("--refine-sigma-m", type=float, help="1-sigma per axis (default: the training's validation; the paper's)")
    parser.add_argument("--licence", help="of the weights (default: unknown; MIT for weights made by formula)")
    return parser


def _config(options: argparse.Namespace) -> NetworkConfig:
    """From `config.json` where there is one, changed by the options."""
    given = {"database_size": options.window, "corr_level": options.levels, "fine_padding": options.padding}
    given = {name: value for name, value in given.items() if value is not None}
    if options.checkpoint is not None and options.checkpoint.is_dir():
        return dataclasses.replace(NetworkConfig.read(options.checkpoint / "config.json"), **given)
    window = given.get("database_size", 1536)
    if "corr_level" not in given and options.checkpoint is not None:
        raise BundleError("--levels: a .pth does not state its correlation levels: expected a number, found none")
    defaults = {"database_size": window, "corr_level": PAPER_LEVELS.get(window, 4), "fine_padding": 32}
    two_stages = not options.one_stage or options.checkpoint is not None
    if options.checkpoint is not None and options.fine is None and options.one_stage:
        two_stages = _has_fine(options.checkpoint)
    return NetworkConfig(resize_width=256, iters_lev0=6, iters_lev1=6, two_stages=two_stages, **(defaults | given))


def _has_fine(path: Path) -> bool:
    document = torch.load(path, map_location="cpu", weights_only=True)
    return isinstance(document, dict) and document.get("netG_fine") is not None


@dataclasses.dataclass(frozen=True)
class Origin:
    """Where weights come from, as far as the files say."""

    description: str
    data: list[str]
    sigma_m: dict[str, float]
    """Per axis, of the stages that were measured."""
    seed: int | None = None
    search_radius_m: float | None = None


def origin_of(checkpoint: Path) -> Origin:
    """Of a training of `sthn.train` by the files of its run; any other checkpoint is taken for the authors' release."""
    made = read_experiment(checkpoint)
    if made is None and stated_lookup(checkpoint) is None:
        description = f"Released STHN checkpoint {checkpoint.name} (Xiao et al., RA-L 2024)."
        return Origin(description, ["Boson-nighttime (ARPL, New York University)"], PAPER_SIGMA_M)
    if made is None:
        return Origin(f"Trained by sthn.train; {checkpoint.name} lies apart from its run, which says on what.", [], {})
    described = {name: made["data"][name] for name in ("train", "extended", "validation") if name in made["data"]}
    data = []
    for name, table in described.items():
        what = {key: table.get(key, made["data"].get(key)) for key in ("kind", "folder", "split", "maps", "map")}
        data.append(f"{name}: " + ", ".join(f"{key} {value}" for key, value in what.items() if value))
    table = made["training"]
    description = (
        f"Trained by sthn.train: {made['row']}. W_S = {made['window_m']}, D_C = {made['search_radius_m']:g} m, "
        f"{table['steps']} steps of {table['batch']}, from {table['init'] or 'random weights'}; {checkpoint.name}."
    )
    return Origin(description, data, _validated(checkpoint), made["seed"], float(made["search_radius_m"]))


def _validated(checkpoint: Path) -> dict[str, float]:
    """Sigma of each stage by `validation.csv`: MACE, which is at least the mean centre error, as the paper's. Of the best row
    for `best`, else of the last."""
    file = checkpoint.resolve().parent / "validation.csv"
    rows = list(csv.DictReader(file.open(encoding="utf-8"))) if file.is_file() else []
    if not rows:
        return {}
    row = min(rows, key=lambda r: float(r["mace_m"])) if checkpoint.name == "best" else rows[-1]
    found = {"coarse": float(row["mace_coarse_m"]) / RAYLEIGH, "refine": float(row["mace_m"]) / RAYLEIGH}
    return {stage: round(sigma, 3) for stage, sigma in found.items()}


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = _arguments()
    options = parser.parse_args(arguments)
    if (options.checkpoint is None) == (options.random_weights is None):
        parser.error("expected either a checkpoint or --random-weights")
    try:
        config = _config(options)
        stages = ("coarse", "refine") if config.two_stages and not options.one_stage else ("coarse",)
        if options.checkpoint is None:
            network = procedural.network(config, options.random_weights)
            origin = Origin(
                "The published architecture with weights made by formula: for tests and benchmarks, it locates nothing.",
                [], PAPER_SIGMA_M,
            )  # fmt: skip
        else:
            network = load_checkpoint(options.checkpoint, config, options.fine, options.lookup and Lookup(options.lookup))
            origin = origin_of(options.checkpoint)
        sigma_m = origin.sigma_m | {s: v for s in stages if (v := getattr(options, f"{s}_sigma_m")) is not None}
        if missing := [f"--{stage}-sigma-m" for stage in stages if stage not in sigma_m]:
            raise BundleError(f"{options.checkpoint}: no validation.csv beside it: expected {', '.join(missing)}, found none")
        if options.one_stage:
            network = one_stage(network)
        spoken = " ".join(sys.argv[1:] if arguments is None else arguments)
        provenance = {"description": origin.description, "command": f"python -m sthn.export {spoken}", "data": origin.data}
        seed = options.random_weights if options.checkpoint is None else origin.seed
        if seed is not None:
            provenance["seed"] = seed
        differences = export(
            network,
            options.out,
            options.name,
            options.licence or ("MIT" if options.checkpoint is None else "unknown: see the checkpoint's source"),
            provenance,
            options.search_radius_m or origin.search_radius_m or max((config.database_size - FRAME_WIDTH_M) / 2, 50.0),
            sigma_m,
        )
    except (ValueError, OSError) as error:
        print(f"export: {error}", file=sys.stderr)
        return 1
    print(options.out)
    for name, value in differences.items():
        print(f"  {name:28} {value:10.3g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
