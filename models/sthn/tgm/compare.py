"""What generated frames do for the coarse stage: trainings with and without, on the same held-out pairs.

    python -m sthn.tgm.compare --trained runs/without runs/with --held-out c.tif --night-maps a.tif b.tif --rendering-seed 4

Pairs over the held-out map with frames of the night that the TGM learnt from, and with frames of the light training's own
random renderer. The error is the distance of the correlation's peak (sub-cell) from the truth, metres.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from ..lite import coarse
from ..lite.pairs import COARSE, Pairs
from ..lite.scene import load_map
from ..lite.train import CoarseTask
from .checkpoint import TgmError
from .frames import NightPairs
from .rendered import Night

SUB_CELL = 2
"""Radius of the soft-argmax about the peak, cells."""


def peak_cells(surface: torch.Tensor) -> np.ndarray:
    """x and y of the peak of `[H, W]`, sub-cell by a soft-argmax about it."""
    h, w = surface.shape
    row, column = divmod(int(surface.argmax()), w)
    top, left = max(0, row - SUB_CELL), max(0, column - SUB_CELL)
    local = surface[top : row + SUB_CELL + 1, left : column + SUB_CELL + 1].double()
    share = torch.softmax(local.flatten(), 0).view(local.shape).numpy()
    y, x = np.mgrid[top : top + share.shape[0], left : left + share.shape[1]]
    return np.array([(share * x).sum(), (share * y).sum()])


def last_weights(folder: Path) -> dict[str, torch.Tensor]:
    """Of the last step, from `last.pt`: the running average in `weights.pt` is, in a short run, mostly the first ones.
    Only where a long run kept no checkpoint, the average."""
    last, average = folder / "last.pt", folder / "weights.pt"
    if last.exists():
        return torch.load(last, weights_only=True)["net"]
    if average.exists():
        return torch.load(average, weights_only=True)
    raise TgmError(f"{folder}: expected last.pt or weights.pt of a coarse training, found neither")


@torch.no_grad()
def errors_m(net: coarse.CoarseNet, pairs: Pairs, count: int) -> np.ndarray:
    """Distances of the answers from the truth over pairs 0 .. count - 1."""
    cell_m = 2 * COARSE.map_width_m / COARSE.map_px
    found = []
    for index in tqdm(range(count), file=sys.stderr, mininterval=5):
        image, frame, relation = pairs.pair(index)
        map_features, frame_features = net.encode_map(image[None]), net.encode_frame(frame[None])
        peak = peak_cells(coarse.correlate_all(map_features, frame_features)[0, 0])
        middle = (relation[:2, 2] / relation[2, 2]).numpy() / (COARSE.map_width_m / COARSE.map_px)
        truth = (middle + (COARSE.map_px - 1) / 2 - 0.5) / 2 - (frame_features.shape[-1] - 1) / 2
        found.append(float(np.hypot(*(peak - truth))) * cell_m)
    return np.array(found)


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.tgm.compare", description=__doc__, formatter_class=raw)
    parser.add_argument("--trained", type=Path, nargs="+", required=True, help="folders of `sthn.lite.train coarse`")
    parser.add_argument("--held-out", type=Path, nargs="+", required=True)
    parser.add_argument("--night-maps", type=Path, nargs="+", required=True, help="maps that the TGM was trained on, same order")
    parser.add_argument("--rendering-seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=100, help="pairs of each kind")
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--table", type=Path)
    args = parser.parse_args(words)
    unseen = [load_map(path) for path in args.held_out]
    night = Night([load_map(path) for path in args.night_maps], args.rendering_seed)
    kinds = {"the TGM's night": NightPairs(unseen, COARSE, args.seed, night), "random": Pairs(unseen, COARSE, args.seed)}
    lines = ["| training | frames | pairs | median m | mean m | <= 25 m |", "|---|---|---|---|---|---|"]
    for folder in args.trained:
        net = CoarseTask().net
        net.load_state_dict(last_weights(folder))
        net.eval()
        for kind, pairs in kinds.items():
            e = errors_m(net, pairs, args.count)
            cells = [folder.name, kind, len(e), f"{np.median(e):.1f}", f"{e.mean():.1f}", f"{100 * (e <= 25).mean():.0f} %"]
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    text = "\n".join(lines)
    print(text)
    if args.table:
        args.table.write_text(text + "\n")


if __name__ == "__main__":
    main()
