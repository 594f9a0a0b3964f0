"""Trains what an experiment describes.

    python -m sthn.train experiments/table-1/ws1536-dc512.toml --out RUN --set data.root='"DATA"'
    python -m sthn.train experiments/table-1/ws1536-dc512-two-stages.toml --out RUN2 --set training.init='"RUN/best"'
    python -m sthn.train ... --out RUN --resume          # from the last checkpoint; --resume FILE from any
    python -m sthn.train ... --out RUN --devices 4       # data parallel; a batch is shared out

Writes `curve.csv`, `validation.csv`, `pictures/`, `checkpoints/`, `best/` and `final/` (released layout: `sthn.export`).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from ..data import open_source
from ..network import Sthn
from . import experiment, saving
from .loop import Loop, make_fabric
from .task import SthnTask


def main(words: list[str] | None = None) -> int:
    """The command line; 2 for a bad experiment, bad data or a bad checkpoint."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.train", description=__doc__, formatter_class=raw)
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--resume", type=Path, nargs="?", const=Path(), help="go on from the last, or a given, checkpoint")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a key of the experiment, as TOML")
    parser.add_argument("--accelerator", default="auto", help="cpu, cuda, ...")
    parser.add_argument("--devices", default="1", help="how many")
    parser.add_argument("--strategy", default="auto", help="Fabric's, for example ddp")
    args = parser.parse_args(words)
    deterministic = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        made = experiment.read(args.experiment, args.set)
        if args.resume is None and (args.out / "checkpoints").exists():
            raise ValueError(f"{args.out}: holds a training already; --resume goes on with it")
        fabric = make_fabric(made.training.precision, args.accelerator, args.devices, args.strategy)
        torch.manual_seed(made.seed)
        network = Sthn(made.config, made.lookup)
        if made.training.init and args.resume is None:
            saving.start_from(network, Path(made.training.init))
        sources = {
            name: open_source(made.source_table(name), f"data.{name}", made.root, "evaluate" if name == "validation" else "train")
            for name in ("train", "validation", "extended")
            if name in made.data
        }
        loop = Loop(
            SthnTask(network, made.training.gamma), made, sources["train"], sources["validation"], sources.get("extended"),
            args.out, fabric,
        )  # fmt: skip
        if args.resume is not None:
            loop.resume(saving.last_checkpoint(args.out) if args.resume == Path() else args.resume)
        loop.run()
    except (ValueError, OSError) as error:
        print(f"train: {error}", file=sys.stderr)
        return 2
    finally:
        torch.use_deterministic_algorithms(deterministic)
    return 0


if __name__ == "__main__":
    sys.exit(main())
