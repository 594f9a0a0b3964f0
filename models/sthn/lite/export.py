"""Trained light stages -> a model bundle, through the one door (`sthn.bundle`).

python -m sthn.lite.export --coarse DIR --refine DIR --out models/bundles/lite-1536
"""

from __future__ import annotations

import argparse
import io
import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import torch

from .. import correlate, geometry
from ..bundle import golden_arrays, in_memory, write_bundle
from . import coarse, refine
from .pairs import FRAME_WIDTH_M, REFINE

OPSET = 17
WINDOW_M, MARGIN_M, SEARCH_RADIUS_M = 1536.0, 128.0, 512.0
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


def golden_pair(side: int, frame_px: int, seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """A map of coloured fields and roads, and the frame cut from it with other values; flat, so that it packs small."""
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
    turn = cv2.getRotationMatrix2D((side / 2 + 170.0, side / 2 - 90.0), 4.0, 1.0)
    turn[:, 2] += np.array([frame_px / 2 - side / 2 - 170.0, frame_px / 2 - side / 2 + 90.0])
    frame = cv2.warpAffine(heat, turn, (frame_px, frame_px), flags=cv2.INTER_NEAREST)
    return picture, frame


def load(folder: Path, net: torch.nn.Module) -> torch.nn.Module:
    """Weights as training left them."""
    net.load_state_dict(torch.load(folder / "weights.pt", weights_only=True))
    return net.eval()


def export(coarse_dir: Path, refine_dir: Path, out: Path, name: str, accuracy: dict | None, commands: list[str]) -> dict:
    """Writes the bundle, checked against torch."""
    torch.manual_seed(0)
    coarse_net = load(coarse_dir, coarse.CoarseNet((16, 32, 64, 96)))
    refine_net = load(refine_dir, refine.RefineNet(REFINE.map_px, REFINE.frame_px))
    map_px = round((WINDOW_M + 2 * MARGIN_M) / COARSE_M_PER_PX)
    frame_px = round(FRAME_WIDTH_M / COARSE_M_PER_PX)
    channels = 32
    # The correlation's map encoder takes any multiple of 16 px: its golden input need not be the whole window.
    small = 96
    with torch.no_grad():
        coarse_map_in = {"map": torch.rand(1, 3, small, small)}
        coarse_in = {"frame": torch.rand(2, 2, frame_px, frame_px)}
        coarse_in["frame"][:, 1] = 1.0
        refine_map_in = {"map": torch.rand(1, 3, REFINE.map_px, REFINE.map_px)}
        features = channels, REFINE.map_px // 2, REFINE.map_px // 2
        refine_in = {"map_features": torch.rand(1, *features), "frame": torch.rand(1, 2, REFINE.frame_px, REFINE.frame_px)}
        refine_in["frame"][:, 1] = 1.0
        free = {2: "height", 3: "width"}
        matcher_out = ["displacement", "residual", "weight", "covariance"]
        graphs = {
            "coarse_map": to_onnx(
                coarse.MapSide(coarse_net), coarse_map_in, ["map_features"], {"map": free, "map_features": free}
            ),
            "coarse": to_onnx(
                coarse.FrameSide(coarse_net),
                coarse_in,
                ["frame_features"],
                {"frame": {0: "batch"}, "frame_features": {0: "batch"}},
            ),
            "refine_map": to_onnx(refine.MapSide(refine_net), refine_map_in, ["map_features"], {}),
            "refine": to_onnx(
                refine.Matcher(refine_net), refine_in, matcher_out, {n: {0: "batch"} for n in ["frame", *matcher_out]}
            ),
        }
    manifest = {
        "schema": 1,
        "name": name,
        "licence": "MIT",
        "provenance": {
            "description": "Light two-stage network of this project, trained on satellite maps with synthetic thermal frames.",
            "command": " && ".join(commands),
            "seed": json.loads((coarse_dir / "training.json").read_text())["seed"],
            "data": [
                "dubai_t7, dubai_t8_east: CC0 (MBRSC / Humans in the Loop)",
                "NAIP North Dakota 2009, 2012, 2015, 2020, west half: public domain (USDA)",
                "procedural worlds of this project",
            ],
        },
        "window_width_m": WINDOW_M,
        "window_margin_m": MARGIN_M,
        "frame_width_m": FRAME_WIDTH_M,
        "m_per_px": 1.0,
        "search_radius_m": SEARCH_RADIUS_M,
        "tone_mapping": 1,
        "opset": OPSET,
        "coarse": {
            "kind": "correlation",
            "map": {"size_px": map_px, "width_m": WINDOW_M + 2 * MARGIN_M, "content": "rgb", "resize": "half_pixel_antialias"},
            "frame": {"size_px": frame_px, "width_m": FRAME_WIDTH_M, "content": "gray_mask", "resize": "half_pixel_antialias"},
            "stride": STRIDE,
            "rotations_deg": list(ROTATIONS_DEG),
            "scales": list(SCALES),
            "subcell_radius": 2,
            "tolerance": 1e-3,
            "match_sigma_m": MATCH_SIGMA_M["coarse"],
        },
        "refine": {
            "kind": "matcher",
            "map": {"size_px": REFINE.map_px, "width_m": REFINE.map_width_m, "content": "rgb", "resize": "supersample"},
            "frame": {
                "size_px": REFINE.frame_px,
                "width_m": FRAME_WIDTH_M,
                "content": "gray_mask",
                "resize": "half_pixel_antialias",
            },
            "lookup": "frame_indexed",
            "crop": {"shape": "oriented", "padding_m": (REFINE.map_width_m - FRAME_WIDTH_M) / 2},
            "tolerance_px": 1e-3,
            "match_sigma_m": MATCH_SIGMA_M["refine"],
        },
    }
    if accuracy:
        manifest["accuracy"] = accuracy
    draft = in_memory(manifest, graphs)
    picture, frame = golden_pair(int(WINDOW_M + 2 * MARGIN_M), int(FRAME_WIDTH_M))
    found = correlate.run_coarse(draft, picture, frame)
    quad, evidence = correlate.run_refine(draft, picture, frame, None, found)
    final = geometry.displacement_of(map_px, geometry.inclusive_of_edges(quad, COARSE_M_PER_PX, MARGIN_M))
    homography = geometry.homography_of_edges(int(FRAME_WIDTH_M), quad)
    print("golden pair:", found.evidence, evidence)
    # What the graphs are fed in the check: the golden pair's own inputs would be large; noise packs badly, so pictures do.
    with torch.no_grad():
        inputs = {
            "coarse_map": {"map": picture_input(picture, small)},
            "coarse": {"frame": frame_input(frame, frame_px)},
            "refine_map": {"map": picture_input(picture, REFINE.map_px)},
        }
        outputs = {
            "coarse_map": {"map_features": coarse_net.encode_map(torch.from_numpy(inputs["coarse_map"]["map"])).numpy()},
            "coarse": {"frame_features": coarse_net.encode_frame(torch.from_numpy(inputs["coarse"]["frame"])).numpy()},
            "refine_map": {"map_features": refine_net.encode_map(torch.from_numpy(inputs["refine_map"]["map"])).numpy()},
        }
        inputs["refine"] = {"frame": frame_input(frame, REFINE.frame_px)}
        matched = refine.Matcher(refine_net)(
            torch.from_numpy(outputs["refine_map"]["map_features"]), torch.from_numpy(inputs["refine"]["frame"])
        )
        outputs["refine"] = {name: value.numpy() for name, value in zip(matcher_out, matched, strict=True)}
    golden = golden_arrays(inputs, outputs)
    golden |= {"map_rgb": picture, "frame": frame, "final": final, "homography": homography}
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
    parser.add_argument("--refine", type=Path, required=True, help="folder of a refine training")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--name")
    parser.add_argument("--accuracy", type=Path, help="JSON of the [accuracy] table, from `sthn.lite.bar`")
    args = parser.parse_args()
    accuracy = json.loads(args.accuracy.read_text()) if args.accuracy else None
    commands = [(folder / "command.txt").read_text().strip() for folder in (args.coarse, args.refine)]
    differences = export(args.coarse, args.refine, args.out, args.name or args.out.name, accuracy, commands)
    for key, value in differences.items():
        print(f"{key}: largest difference {value:.2e}")


if __name__ == "__main__":
    main()
