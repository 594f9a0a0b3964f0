"""`python models/tests/rust_parity_light.py BUNDLE DIR`: the Python side of `tests/parity_light.rs`.

For a bundle of kind `correlation`, makes in DIR a window with its margin and frames with and without unseen corners, and prints
as JSON what `sthn.correlate` finds: the frame's edges in the window after each stage, and the evidence.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from sthn import correlate
from sthn.bundle import read_bundle
from sthn.lite.export import golden_pair


def unseen_corners(side: int) -> np.ndarray:
    """1 inside a turned rectangle, 0 outside."""
    mask = np.zeros((side, side), np.uint8)
    box = cv2.boxPoints(((side * 0.48, side * 0.52), (side * 1.1, side * 0.9), 33.0))
    cv2.fillPoly(mask, [box.astype(np.int32)], 1)
    return mask


def main(bundle_folder: Path, folder: Path) -> None:
    """Writes the files and prints the numbers."""
    bundle = read_bundle(bundle_folder)
    manifest = bundle.manifest
    side = int(manifest["window_width_m"] + 2 * manifest["window_margin_m"])
    frame_px = int(manifest["frame_width_m"])
    window, frame = golden_pair(side, frame_px, seed=21)
    Image.fromarray(window).save(folder / "window.png")
    centre = (manifest["window_width_m"] - 1) / 2
    cases = []
    for name, mask, disc in (
        ("whole", np.ones((frame_px, frame_px), np.uint8), None),
        ("corners", unseen_corners(frame_px), None),
        ("disc", unseen_corners(frame_px), (centre + 140.0, centre - 60.0, 150.0)),
    ):
        seen = frame * mask
        Image.fromarray(seen).save(folder / f"{name}.png")
        Image.fromarray(mask).save(folder / f"{name}_mask.png")
        coarse = correlate.run_coarse(bundle, window, seen, mask, disc)
        case = {"name": name, "disc": disc, "coarse": coarse.quad.tolist(), "evidence": coarse.evidence, "quad": None}
        if "refine" in manifest:
            quad, evidence = correlate.run_refine(bundle, window, seen, mask, coarse)
            case["quad"] = quad.tolist()
            case["evidence"] = coarse.evidence | evidence
        cases.append(case)
    json.dump(cases, sys.stdout)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
