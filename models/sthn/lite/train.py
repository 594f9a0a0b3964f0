"""Training of the light stages: one resumable, seeded command a stage.

    python -m sthn.lite.train coarse --maps DIR --worlds DIR --out DIR [--steps N] [--seed S]
    python -m sthn.lite.train refine ...

The same command goes on from the last checkpoint in `--out`; with another recipe it is an error. `curve.csv` and
`command.txt` stay beside the weights.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader
from tqdm import tqdm

from ..tgm.frames import PairsWithGenerated, load_generated
from . import coarse, refine
from .pairs import COARSE, FRAME_WIDTH_M, REFINE, Pairs
from .scene import SceneMap, load_map, px_to_m

# The first two Dubai maps are for training; dubai_t4_west and naip_berkeley stay apart for calibration, the east half
# of the North Dakota maps for the change between dates.
TRAIN_MAPS = ("dubai_t7.tif", "dubai_t8_east.tif")
NORTH_DAKOTA = tuple(f"naip_north_dakota_5m_{date}.tif" for date in ("20090818", "20120731", "20150926", "20200831"))
NORTH_DAKOTA_WEST = slice(0, 467)
CALIBRATION_MAPS = ("dubai_t4_west.tif", "naip_berkeley.tif")


def training_scenes(maps: Path, worlds: list[Path]) -> list[SceneMap]:
    """The training maps under `maps` and procedural worlds."""
    scenes = [load_map(maps / name) for name in TRAIN_MAPS]
    for index, name in enumerate(NORTH_DAKOTA):
        others = tuple(maps / n for i, n in enumerate(NORTH_DAKOTA) if i != index)
        scenes.append(load_map(maps / name, others, NORTH_DAKOTA_WEST))
    return scenes + [load_map(path) for path in worlds]


class CoarseTask:
    """What training needs to know of the coarse stage."""

    spec = COARSE
    columns = ("loss", "hit_2_cells", "own_map")

    def __init__(self) -> None:
        self.net = coarse.CoarseNet((16, 32, 64, 96))

    def loss(self, batch) -> tuple[torch.Tensor, dict[str, float]]:
        image, frame, relation = batch
        with torch.autocast("cpu", torch.bfloat16):
            fm = self.net.encode_map(image)
            ff = self.net.encode_frame(frame)
        surfaces = coarse.correlate_all(fm, ff)
        spec = self.spec
        middle = relation[:, :2, 2] / relation[:, 2:3, 2]
        px = middle / (spec.map_width_m / spec.map_px) + (spec.map_px - 1) / 2
        cell = (px - 0.5) / 2 - (ff.shape[-1] - 1) / 2
        loss = coarse.loss_of(surfaces, cell.float())
        b, _, h, w = surfaces.shape
        best = surfaces.detach().reshape(b, -1).argmax(1)
        own = best // (h * w) == torch.arange(b)
        at = torch.stack([best % w, best % (h * w) // w], 1)
        hit = own & ((at - cell).abs().amax(1) <= 2)
        return loss.clamp(max=12.0).mean(), {"hit_2_cells": hit.float().mean().item(), "own_map": own.float().mean().item()}


class RefineTask:
    """What training needs to know of the refine stage."""

    spec = REFINE
    columns = ("loss", "corner_m", "median_m")

    def __init__(self) -> None:
        self.net = refine.RefineNet(self.spec.map_px, self.spec.frame_px)

    def loss(self, batch) -> tuple[torch.Tensor, dict[str, float]]:
        image, frame, relation = batch
        with torch.autocast("cpu", torch.bfloat16):
            features = self.net.encode_map(image)
            features_frame = self.net.encode_standard(frame)
        to_m = torch.from_numpy(px_to_m(self.spec.frame_px, FRAME_WIDTH_M))
        to_px = torch.linalg.inv(torch.from_numpy(px_to_m(self.spec.map_px, self.spec.map_width_m)))
        truth = (to_px @ relation @ to_m).float()
        steps = self.net.iterate(features, *features_frame)
        loss, corner = refine.loss_of(self.net, steps, truth)
        m = FRAME_WIDTH_M / self.spec.frame_px
        return loss.mean(), {"corner_m": corner.mean().item() * m, "median_m": corner.median().item() * m}


TASKS = {"coarse": CoarseTask, "refine": RefineTask}


def learning_rate(step: int, steps: int, peak: float, warm_up: int = 100) -> float:
    """Warm-up, then a cosine to zero."""
    if step < warm_up:
        return peak * (step + 1) / warm_up
    return peak * 0.5 * (1 + math.cos(math.pi * (step - warm_up) / max(1, steps - warm_up)))


def start_from(net: torch.nn.Module, weights: Path) -> None:
    """Weights of the same stage as a start; of another stage its encoders: features that match across the spectra serve
    at every scale."""
    found = torch.load(weights, weights_only=True)
    if found.keys() == net.state_dict().keys():
        net.load_state_dict(found)
        return
    encoders = {name: value for name, value in found.items() if name.startswith(("map_encoder.", "frame_encoder."))}
    missing, extra = net.load_state_dict(encoders, strict=False)
    if extra or any(name.startswith(("map_encoder.", "frame_encoder.")) for name in missing):
        raise SystemExit(f"{weights}: expected the encoders of this stage, found others ({extra or missing})")


def recipe_of(args: argparse.Namespace, scenes: list[SceneMap]) -> dict[str, Any]:
    """What a training that goes on must have in common with its beginning."""
    share = args.generated_share if args.generated else 0.0
    kept = {key: getattr(args, key) for key in ("stage", "steps", "batch", "peak", "seed")}
    return kept | {"generated_share": share, "scenes": [scene.name for scene in scenes]}


def train(args: argparse.Namespace) -> None:
    """Runs, or goes on with, a training."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    worlds = sorted(p for p in args.worlds.glob("**/*.tif") if not p.stem.endswith("_classes")) if args.worlds else []
    if args.worlds and not worlds:
        raise SystemExit(f"{args.worlds}: expected at least one GeoTIFF of `nightfix simulate --world`, found none")
    scenes = training_scenes(args.maps, worlds)
    task = TASKS[args.stage]()
    net = task.net.to(memory_format=torch.channels_last)
    average = torch.optim.swa_utils.AveragedModel(
        net, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.998), use_buffers=True
    )
    optimiser = torch.optim.AdamW(net.parameters(), lr=args.peak, weight_decay=1e-4)
    step, spent_s = 0, 0.0
    if args.init and not (args.out / "last.pt").exists():
        start_from(net, args.init / "weights.pt")
        average.module.load_state_dict(net.state_dict())
    last = args.out / "last.pt"
    recipe = recipe_of(args, scenes)
    if last.exists():
        kept = torch.load(last, weights_only=True)
        # Checkpoints from before recipes were kept have none to compare.
        if kept.get("recipe", recipe) != recipe:
            raise SystemExit(f"{last}: recipe: expected {recipe}, found {kept['recipe']}")
        net.load_state_dict(kept["net"])
        average.load_state_dict(kept["average"])
        optimiser.load_state_dict(kept["optimiser"])
        step, spent_s = kept["step"], kept["spent_s"]
    (args.out / "command.txt").write_text("python -m sthn.lite.train " + " ".join(args.words) + "\n")
    if args.generated:
        pairs: Pairs = PairsWithGenerated(
            scenes, task.spec, args.seed, step * args.batch, load_generated(args.generated, scenes), args.generated_share
        )
    else:
        pairs = Pairs(scenes, task.spec, args.seed, start=step * args.batch)
    loader = DataLoader(pairs, args.batch, num_workers=args.workers, prefetch_factor=3 if args.workers else None)
    curve = args.out / "curve.csv"
    # Rows that a stopped run wrote after its last checkpoint are written again.
    _, *rows = curve.read_text().splitlines() if curve.exists() else [""]
    kept_rows = [row for row in rows if int(row.split(",")[0]) <= step]
    curve.write_text("\n".join([",".join(["step", "seconds", *task.columns]), *kept_rows]) + "\n")
    sums: dict[str, float] = {}
    began = time.monotonic()
    with tqdm(total=args.steps, initial=step, mininterval=5, file=sys.stderr) as bar:
        for batch in loader:
            if step >= args.steps:
                break
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(step, args.steps, args.peak)
            batch[0] = batch[0].contiguous(memory_format=torch.channels_last)
            loss, seen = task.loss(batch)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            average.update_parameters(net)
            step += 1
            bar.update()
            for key, value in {"loss": loss.item(), **seen}.items():
                sums[key] = sums.get(key, 0.0) + value
            if step % args.every == 0 or step == args.steps:
                seconds = spent_s + time.monotonic() - began
                count = args.every if step % args.every == 0 else step % args.every
                row = {key: value / count for key, value in sums.items()}
                with curve.open("a") as file:
                    csv.writer(file).writerow([step, round(seconds), *(f"{row[key]:.4f}" for key in task.columns)])
                bar.set_postfix({key: f"{value:.3f}" for key, value in row.items()})
                sums = {}
            if step % args.save == 0 or step == args.steps:
                state = {
                    "net": net.state_dict(),
                    "average": average.state_dict(),
                    "optimiser": optimiser.state_dict(),
                    "recipe": recipe,
                    "step": step,
                    "spent_s": spent_s + time.monotonic() - began,
                }
                torch.save(state, last.with_suffix(".tmp"))
                last.with_suffix(".tmp").replace(last)
    torch.save(average.module.state_dict(), args.out / "weights.pt")
    facts = {"stage": args.stage, "seed": args.seed, "steps": step, "batch": args.batch, "scenes": [s.name for s in scenes]}
    (args.out / "training.json").write_text(json.dumps(facts, indent=2) + "\n")


def main(words: list[str] | None = None) -> None:
    """The command line."""
    words = sys.argv[1:] if words is None else words
    parser = argparse.ArgumentParser(
        prog="sthn.lite.train", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stage", choices=sorted(TASKS))
    parser.add_argument("--maps", type=Path, required=True, help="folder of the training maps")
    parser.add_argument("--worlds", type=Path, help="folder of procedural worlds (GeoTIFF, `nightfix simulate --world`)")
    parser.add_argument("--generated", type=Path, help="folder of thermal maps painted by `sthn.tgm generate`, named as the maps")
    parser.add_argument("--generated-share", type=float, default=0.5, help="of the frames over maps that have one")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--init", type=Path, help="folder of a training whose weights (same stage) or encoders (another) are the start"
    )
    parser.add_argument("--steps", type=int, default=1600)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--peak", type=float, default=3e-3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--every", type=int, default=25, help="steps a row of the curve")
    parser.add_argument("--save", type=int, default=100, help="steps a checkpoint")
    args = parser.parse_args(words)
    args.words = words
    train(args)


if __name__ == "__main__":
    main()
