"""One small loop for the learned rivals: L1 on the displacement, AdamW, one cycle.

    python -m sthn.rivals.train ihn --data pairs.toml --out runs/ihn --steps 400 --seed 1
    python -m sthn.rivals.train dhn --maps a.tif b.tif --window-m 512 --search-radius-m 64 --out runs/dhn --steps 400

`pairs.toml` has a table `[train]`, a source as in `sthn.data.spec`, and may have `[training]`: the options below, which the
command line overrides (`models/experiments/rivals`: the rows of Table I). The same command goes on from the last checkpoint in
`--out`; `weights.pt`, `training.json` and `curve.csv` are what the rival and the report need.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from ..data import DataError, open_source
from ..data.pair import TrainingSource
from ..data.spec import check
from .base import RivalError, ground_m
from .learned import NETWORKS, inputs

FRAME_WIDTH_M = 512

GAMMA = 0.85
"""Weight of an iteration against the next: paper, Eq. (3)."""


def loss_of(displacements: Tensor, truth: Tensor) -> Tensor:
    """`[K, B, 2, 2, 2]` against `[B, 2, 2, 2]`: sum of gamma^(K - k - 1) mean |D_k - D|."""
    last = len(displacements) - 1
    return sum(GAMMA ** (last - k) * (d - truth).abs().mean() for k, d in enumerate(displacements))


class Inputs(Dataset):
    """Map, frame `[3, n, n]` and truth `[2, 2, 2]` (pixels of the input) of a source's pairs, by pass and index. Every pass
    draws anew (shift, noise, rendering), as `train.stream` does for the published network."""

    def __init__(self, source: TrainingSource, side_px: int, seed: int) -> None:
        self.source, self.side_px, self.seed = source, side_px, seed

    def __getitem__(self, place: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
        passed, index = place
        pair = self.source.reseeded((self.seed, passed))[index]
        return *inputs(pair, self.side_px), torch.from_numpy(pair.displacement(self.side_px)).float()


def plan(pairs: int, batch: int, steps: int, seed: int) -> list[list[tuple[int, int]]]:
    """Pass and index of every pair of every step's batch: passes over the source, each in its own order."""
    order, passed = [], 0
    while len(order) < steps * batch:
        order += [(passed, index) for index in np.random.default_rng([seed, passed]).permutation(pairs).tolist()]
        passed += 1
    return [order[i * batch : (i + 1) * batch] for i in range(steps)]


def train(
    key: str,
    source: TrainingSource,
    out: Path,
    steps: int,
    seed: int,
    side_px: int = 128,
    batch: int = 8,
    peak: float = 4e-4,
    workers: int = 0,
    device: str = "cpu",
    save_every: int = 100,
    stop_after: int | None = None,
) -> None:
    """Runs, or goes on with, a training. `stop_after`: ends early at this step with a checkpoint and no weights."""
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    net = NETWORKS[key][1](side_px).train().to(device)
    optimiser = torch.optim.AdamW(net.parameters(), peak, weight_decay=1e-5)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, peak, steps + 100, pct_start=0.05, cycle_momentum=False, anneal_strategy="linear"
    )
    last, curve = out / "last.pt", out / "curve.csv"
    step, spent_s = 0, 0.0
    recipe = {
        "rival": key,
        "side_px": side_px,
        "window_m": ground_m(source[0]),
        "search_radius_m": source.search_radius_m,
        "source": source.name,
        "steps": steps,
        "batch": batch,
        "peak": peak,
        "seed": seed,
    }
    if last.exists():
        kept = torch.load(last, weights_only=True, map_location="cpu")
        if kept["recipe"] != recipe:
            raise RivalError(f"{last}: recipe: expected {recipe}, found {kept['recipe']}")
        net.load_state_dict(kept["net"])
        optimiser.load_state_dict(kept["optimiser"])
        schedule.load_state_dict(kept["schedule"])
        torch.set_rng_state(kept["random"])
        if "random_cuda" in kept and device.startswith("cuda"):
            torch.cuda.set_rng_state(kept["random_cuda"], device)
        step, spent_s = kept["step"], kept["spent_s"]
    rows = curve.read_text().splitlines()[1:] if curve.exists() else []
    rows = [row for row in rows if int(row.split(",")[0]) <= step]
    curve.write_text("\n".join(["step,seconds,loss,mace_px", *rows]) + "\n")
    batches = plan(len(source), batch, steps, seed)[step : stop_after or steps]
    # Its own generator: a loader draws a number at its start, which would move the dropout of a resumed run.
    own = torch.Generator()
    loader = DataLoader(Inputs(source, side_px, seed), batch_sampler=batches, num_workers=workers, generator=own)
    began = time.monotonic()
    for map_image, frame, truth in tqdm(loader, key, initial=step, total=steps, mininterval=5, file=sys.stderr):
        map_image, frame, truth = (tensor.to(device) for tensor in (map_image, frame, truth))
        displacements = net(map_image, frame)
        loss = loss_of(displacements, truth)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        step += 1
        mace_px = (displacements[-1].detach() - truth).norm(dim=1).mean().item()
        seconds = spent_s + time.monotonic() - began
        with curve.open("a") as file:
            file.write(f"{step},{seconds:.0f},{loss.item():.4f},{mace_px:.3f}\n")
        if step % save_every == 0 or step in (steps, stop_after):
            state = {"net": net.state_dict(), "optimiser": optimiser.state_dict(), "schedule": schedule.state_dict()}
            state |= {"random": torch.get_rng_state(), "recipe": recipe, "step": step, "spent_s": seconds}
            if device.startswith("cuda"):
                state["random_cuda"] = torch.cuda.get_rng_state(device)
            torch.save(state, last.with_suffix(".tmp"))
            last.with_suffix(".tmp").replace(last)
            spent_s, began = seconds, time.monotonic()
    if step == steps:
        torch.save({name: value.cpu() for name, value in net.state_dict().items()}, out / "weights.pt")
        facts = recipe | {"seconds": round(spent_s), "parameters": sum(p.numel() for p in net.parameters())}
        (out / "training.json").write_text(json.dumps(facts, indent=2) + "\n")


TABLE = {"steps": int, "seed": int, "side_px": int, "batch": int, "peak": float, "workers": int}


def read_tables(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """`[train]` and `[training]` of a `--data` file."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RivalError(f"{path}: {error}") from error
    if not isinstance(document.get("train"), dict):
        raise RivalError(f"{path}: train: expected a table, found {document.get('train')!r}")
    check(document, {"train": dict, "training": dict}, str(path))
    check(document.get("training", {}), TABLE, f"{path}: training")
    return document["train"], document.get("training", {})


def open_training(args: argparse.Namespace) -> TrainingSource:
    """The source of the command line."""
    if (args.data is None) == (not args.maps):
        raise RivalError("train: expected one of --data and --maps")
    if args.data:
        return open_source(read_tables(args.data)[0], f"{args.data}: train", args.root or args.data.parent, "train")
    side = {"window_m": round(args.window_m / args.m_per_px), "frame_px": round(FRAME_WIDTH_M / args.m_per_px)}
    table = {"kind": "maps", "maps": [str(path) for path in args.maps], "m_per_px": args.m_per_px, "count": args.pairs}
    return open_source(table | side | {"search_radius_m": args.search_radius_m, "seed": args.seed, "augment": True}, "train")


def main(words: list[str] | None = None) -> int:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.rivals.train", description=__doc__, formatter_class=raw)
    parser.add_argument("rival", choices=sorted(NETWORKS))
    parser.add_argument("--data", type=Path, help="TOML with a table [train]")
    parser.add_argument("--root", type=Path, help="what the paths of --data are relative to (default: its folder)")
    parser.add_argument("--maps", type=Path, nargs="+", help="GeoTIFFs; thermal is made on the fly")
    parser.add_argument("--window-m", type=int, default=512)
    parser.add_argument("--m-per-px", type=float, default=1.0, help="of the pairs; 4 is enough for 128 px and 16 times as fast")
    parser.add_argument("--search-radius-m", type=float, default=64.0)
    parser.add_argument("--pairs", type=int, default=4000, help="pairs a pass, with --maps")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--side-px", type=int, default=128)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--peak", type=float, default=4e-4)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args(words)
    try:
        if args.data:
            parser.set_defaults(**read_tables(args.data)[1])
            args = parser.parse_args(words)
        source = open_training(args)
        options = {key: getattr(args, key) for key in (*TABLE, "device")}
        train(args.rival, source, args.out, **options)
    except (RivalError, DataError) as error:
        print(f"sthn.rivals.train: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
