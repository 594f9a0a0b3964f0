"""Trained light stages -> a model bundle, through the one door (`sthn.bundle`).

    python -m sthn.lite.export --coarse DIR --refine DIR --out models/bundles/lite-1536
    python -m sthn.lite.export --coarse DIR --refine DIR --window-m 512 --radius-m 64 --out models/bundles/lite-512

One training serves every rung of the ladder: the map's features belong to the map, so that a window is a slice of them.
"""

from __future__ import annotations

import argparse
import io
import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from .. import correlate, geometry
from ..bundle import golden_arrays, in_memory, write_bundle
from . import coarse, refine
from .pairs import FRAME_WIDTH_M, REFINE

OPSET = 17
MARGIN_M = 128.0
COARSE_M_PER_PX = 16 / 3
STRIDE = 2
# Steps of the training's own noise (5.5 degrees, 7.5 %), so that a truth in between is seen by its neighbours.
ROTATIONS_DEG = (-12.0, -6.0, 0.0, 6.0, 12.0)
SCALES = (0.9, 1.0, 1.1)
# Uncalibrated, from the bar's table (`models/bundles/lite-1536/bar.md`): its P95 over sqrt(5.991).
MATCH_SIGMA_M = {"coarse": 8.0, "refine": 3.0}


def to_onnx(module: torch.nn.Module, inputs: dict[str, torch.Tensor], outputs: list[str], dynamic: dict) -> bytes:
    """An ONNX graph. Every example input is a tensor of its own: a shared one is silently aliased."""
    buffer = io.BytesIO()
    module.eval()  # the exporter leaves it, and all in it, as it found the outermost module
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            buffer,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_axes=dynamic,
            opset_version=OPSET,
            dynamo=False,
        )
    return buffer.getvalue()


def golden_pair(side: int, frame_px: int, seed: int = 7, radius_m: float = 512.0) -> tuple[np.ndarray, np.ndarray]:
    """A map of coloured fields and roads, and the frame cut from it with other values; flat, so that it packs small. The
    frame lies 0.38 D_C from the middle."""
    rng = np.random.default_rng(seed)
    picture = np.full((side, side, 3), (110, 120, 90), np.uint8)
    heat = np.full((side, side), 90, np.uint8)
    for _ in range(160):
        centre = rng.uniform(0, side, 2)
        size = rng.uniform(20, 160, 2)
        box = cv2.boxPoints((tuple(centre), tuple(size), rng.uniform(0, 180))).astype(np.int32)
        cv2.fillPoly(picture, [box], tuple(int(v) for v in rng.integers(30, 220, 3)))
        cv2.fillPoly(heat, [box], int(rng.integers(20, 235)))
    for _ in range(14):
        line = rng.uniform(0, side, (5, 2)).astype(np.int32)
        width = int(rng.integers(5, 14))
        cv2.polylines(picture, [line], False, (180, 180, 175), width)
        cv2.polylines(heat, [line], False, 220, width)
    shift = np.array([170.0, -90.0]) * radius_m / 512.0
    turn = cv2.getRotationMatrix2D(tuple(side / 2 + shift), 4.0, 1.0)
    turn[:, 2] += frame_px / 2 - side / 2 - shift
    frame = cv2.warpAffine(heat, turn, (frame_px, frame_px), flags=cv2.INTER_NEAREST)
    return picture, frame


def load(folder: Path, net: torch.nn.Module) -> torch.nn.Module:
    """Weights as training left them."""
    net.load_state_dict(torch.load(folder / "weights.pt", weights_only=True))
    return net.eval()


@dataclass
class Exported:
    """A stage, as its part of the bundle: graphs, manifest table, golden inputs and torch's outputs."""

    graphs: dict[str, bytes]
    table: dict
    inputs: dict[str, dict[str, np.ndarray]]
    outputs: dict[str, dict[str, np.ndarray]]


def coarse_stage(folder: Path, picture: np.ndarray, frame: np.ndarray, window_m: float) -> Exported:
    """The correlation stage."""
    net = load(folder, coarse.CoarseNet((16, 32, 64, 96)))
    # The map encoder takes any multiple of 16 px: its golden input need not be the whole window.
    small = 96
    frame_px = round(FRAME_WIDTH_M / COARSE_M_PER_PX)
    free = {2: "height", 3: "width"}
    example = torch.rand(2, 2, frame_px, frame_px)
    example[:, 1] = 1.0
    batch = {"frame": {0: "batch"}, "frame_features": {0: "batch"}}
    graphs = {
        "coarse_map": to_onnx(
            coarse.MapSide(net), {"map": torch.rand(1, 3, small, small)}, ["map_features"], {"map": free, "map_features": free}
        ),
        "coarse": to_onnx(coarse.FrameSide(net), {"frame": example}, ["frame_features"], batch),
    }
    width_m = window_m + 2 * MARGIN_M
    table = {
        "kind": "correlation",
        "map": input_spec(round(width_m / COARSE_M_PER_PX), width_m, "rgb", "half_pixel_antialias"),
        "frame": input_spec(frame_px, FRAME_WIDTH_M, "gray_mask", "half_pixel_antialias"),
        "stride": STRIDE,
        "rotations_deg": list(ROTATIONS_DEG),
        "scales": list(SCALES),
        "subcell_radius": 2,
        "tolerance": 1e-3,
        "match_sigma_m": MATCH_SIGMA_M["coarse"],
    }
    inputs = {"coarse_map": {"map": picture_input(picture, small)}, "coarse": {"frame": frame_input(frame, frame_px)}}
    with torch.no_grad():
        outputs = {
            "coarse_map": {"map_features": net.encode_map(torch.from_numpy(inputs["coarse_map"]["map"])).numpy()},
            "coarse": {"frame_features": net.encode_frame(torch.from_numpy(inputs["coarse"]["frame"])).numpy()},
        }
    return Exported(graphs, table, inputs, outputs)


def refine_stage(folder: Path, picture: np.ndarray, frame: np.ndarray) -> Exported:
    """The matcher stage."""
    net = load(folder, refine.RefineNet(REFINE.map_px, REFINE.frame_px))
    named = ["displacement", "residual", "weight", "covariance", "iterations"]
    with torch.no_grad():
        features = net.encode_map(torch.rand(1, 3, REFINE.map_px, REFINE.map_px))
    example = torch.rand(1, 2, REFINE.frame_px, REFINE.frame_px)
    example[:, 1] = 1.0
    graphs = {
        "refine_map": to_onnx(refine.MapSide(net), {"map": torch.rand(1, 3, REFINE.map_px, REFINE.map_px)}, ["map_features"], {}),
        "refine": to_onnx(
            refine.Matcher(net),
            {"map_features": features, "frame": example},
            named,
            {name: {1 if name == "iterations" else 0: "batch"} for name in ["frame", *named]},
        ),
    }
    table = {
        "kind": "matcher",
        "map": input_spec(REFINE.map_px, REFINE.map_width_m, "rgb", "supersample"),
        "frame": input_spec(REFINE.frame_px, FRAME_WIDTH_M, "gray_mask", "half_pixel_antialias"),
        "lookup": "frame_indexed",
        "crop": {"shape": "oriented", "padding_m": (REFINE.map_width_m - FRAME_WIDTH_M) / 2},
        "tolerance_px": 4e-3,  # a centimetre on the ground; 1.1e-3 was seen between PyTorch and ONNX Runtime
        "match_sigma_m": MATCH_SIGMA_M["refine"],
    }
    inputs = {
        "refine_map": {"map": picture_input(picture, REFINE.map_px)},
        "refine": {"frame": frame_input(frame, REFINE.frame_px)},
    }
    with torch.no_grad():
        features = net.encode_map(torch.from_numpy(inputs["refine_map"]["map"]))
        matched = refine.Matcher(net)(features, torch.from_numpy(inputs["refine"]["frame"]))
    outputs = {
        "refine_map": {"map_features": features.numpy()},
        "refine": {name: value.numpy() for name, value in zip(named, matched, strict=True)},
    }
    return Exported(graphs, table, inputs, outputs)


def input_spec(size_px: int, width_m: float, content: str, resize: str) -> dict:
    """An `InputSpec` of the manifest."""
    return {"size_px": size_px, "width_m": width_m, "content": content, "resize": resize}


@dataclass(frozen=True)
class Rung:
    """What differs between the bundles of a ladder."""

    window_m: float = 1536.0
    """W_S."""
    radius_m: float = 512.0
    """D_C."""
    scale_range: tuple[float, float] | None = None


def commands(training: Path) -> list[str]:
    """Every run of a training, the first first: `command-1.txt`, ..., `command.txt`."""
    runs = [*sorted(training.glob("command-*.txt")), training / "command.txt"]
    return [path.read_text().strip() for path in runs]


def export(coarse_dir: Path, refine_dir: Path | None, out: Path, name: str, rung: Rung) -> dict[str, float]:
    """Writes the bundle, checked against torch; returns the largest difference of every golden output."""
    torch.manual_seed(0)
    picture, frame = golden_pair(int(rung.window_m + 2 * MARGIN_M), int(FRAME_WIDTH_M), radius_m=rung.radius_m)
    stages = {"coarse": coarse_stage(coarse_dir, picture, frame, rung.window_m)}
    if refine_dir:
        stages["refine"] = refine_stage(refine_dir, picture, frame)
    graphs = {key: onnx for stage in stages.values() for key, onnx in stage.graphs.items()}
    trainings = [folder for folder in (coarse_dir, refine_dir) if folder]
    manifest = {
        "schema": 1,
        "name": name,
        "licence": "MIT",
        "provenance": {
            "description": "Light network of this project, trained on satellite maps with synthetic thermal frames.",
            "command": " && ".join(command for folder in trainings for command in commands(folder)),
            "seed": json.loads((coarse_dir / "training.json").read_text())["seed"],
            "data": [
                "dubai_t7, dubai_t8_east: CC0 (MBRSC / Humans in the Loop)",
                "NAIP North Dakota 2009, 2012, 2015, 2020, west half: public domain (USDA)",
                "procedural worlds of this project",
            ],
        },
        "window_width_m": rung.window_m,
        "window_margin_m": MARGIN_M,
        "frame_width_m": FRAME_WIDTH_M,
        "m_per_px": 1.0,
        "search_radius_m": rung.radius_m,
        "tone_mapping": 1,
        "opset": OPSET,
        **{key: stage.table for key, stage in stages.items()},
    }
    if rung.scale_range:
        manifest["scale_range"] = list(rung.scale_range)
    draft = in_memory(manifest, graphs)
    found = correlate.run_coarse(draft, picture, frame)
    quad, evidence = found.quad, dict(found.evidence)
    if refine_dir:
        quad, more = correlate.run_refine(draft, picture, frame, None, found)
        evidence |= more
    print("golden pair:", ", ".join(f"{key} {value:.4g}" for key, value in evidence.items()))
    golden = golden_arrays(
        {key: value for stage in stages.values() for key, value in stage.inputs.items()},
        {key: value for stage in stages.values() for key, value in stage.outputs.items()},
    )
    inclusive = geometry.inclusive_of_edges(quad, COARSE_M_PER_PX, MARGIN_M)
    golden |= {
        "map_rgb": picture,
        "frame": frame,
        "final": geometry.displacement_of(stages["coarse"].table["map"]["size_px"], inclusive),
        "homography": geometry.homography_of_edges(int(FRAME_WIDTH_M), quad),
    }
    return write_bundle(out, manifest, graphs, golden)


def picture_input(picture: np.ndarray, size_px: int) -> np.ndarray:
    """The middle of the picture as a map input."""
    side = picture.shape[0]
    crop = picture[side // 2 - 320 : side // 2 + 320, side // 2 - 320 : side // 2 + 320]
    return np.ascontiguousarray(np.moveaxis(correlate.resize(crop.astype(np.float32) / 255.0, size_px), -1, 0)[None])


def frame_input(frame: np.ndarray, size_px: int) -> np.ndarray:
    """The frame, seen whole, as a frame input."""
    gray = correlate.resize(frame.astype(np.float32) / 255.0, size_px)
    return np.stack([gray, np.ones_like(gray)])[None].astype(np.float32)


def main() -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.lite.export", description=__doc__, formatter_class=raw)
    parser.add_argument("--coarse", type=Path, required=True, help="folder of a coarse training")
    parser.add_argument("--refine", type=Path, help="folder of a refine training; none makes a one-stage bundle")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--name")
    parser.add_argument("--window-m", type=float, default=1536.0, help="W_S")
    parser.add_argument("--radius-m", type=float, default=512.0, help="D_C")
    parser.add_argument("--scale-range", type=float, nargs=2, help="as measured by `sthn.lite.scales`")
    args = parser.parse_args()
    rung = Rung(args.window_m, args.radius_m, tuple(args.scale_range) if args.scale_range else None)
    differences = export(args.coarse, args.refine, args.out, args.name or args.out.name, rung)
    for key, value in differences.items():
        print(f"{key}: largest difference {value:.2e}")


if __name__ == "__main__":
    main()
