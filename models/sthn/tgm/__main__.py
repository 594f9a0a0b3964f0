"""`python -m sthn.tgm train|generate`. See `--help` of each.

python -m sthn.tgm train --maps a.tif b.tif --held-out c.tif --rendering-seed 4 --out DIR        (a made-up night)
python -m sthn.tgm generate --checkpoint DIR/best_model.pth --map a.tif --h5 G/extended_queries_test_excluded.h5 \\
    --database G/extended_database.h5 --exclude 0,2000,3000,5000
python -m sthn.tgm generate --checkpoint TGM.pth --map 20201117_BingSatellite.png --exclude published --h5 ... --database ...
python -m sthn.tgm generate --checkpoint DIR/best_model.pth --map a.tif --thermal-map a_thermal.tif

Training takes an extended set by that name only: it says that the ground of the test flights is left out, which --exclude does.
For training with geometric noise give --width-m 768 --size-px 768: what is beyond a frame's 512 px then fills its corners.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import rasterio
import torch
from torch.utils.data import ConcatDataset

from ..data import DataError, PairSource, boson, open_source
from ..lite.scene import load_map, read_rgb
from . import generate
from .checkpoint import TgmError, load_generator, read
from .pairs import MAX_BLACK_PX, AlignedPairs, usable_indices
from .rendered import FRAME_WIDTH_M, Night, RenderedPairs
from .train import Recipe, train


def open_sources(args: argparse.Namespace, recipe: Recipe) -> tuple[list[PairSource], PairSource]:
    """What to train on, and what to validate on."""
    if (args.data is None) == (args.maps is None):
        raise TgmError("train: expected one of --data and --maps")
    if args.data:
        try:
            tables = tomllib.loads(args.data.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise TgmError(f"{args.data}: {error}") from error
        if not isinstance(tables.get("train"), list) or not tables["train"]:
            raise TgmError(f"{args.data}: train: expected at least one table [[train]], found {tables.get('train')!r}")
        if not isinstance(tables.get("held_out"), dict):
            raise TgmError(f"{args.data}: held_out: expected a table, found {tables.get('held_out')!r}")
        opened = [
            open_source(table, f"{args.data}: {name}", args.root or args.data.parent, purpose)
            for name, table, purpose in (
                *((f"train {i}", table, "train") for i, table in enumerate(tables["train"])),
                ("held_out", tables["held_out"], "evaluate"),
            )
        ]
        return opened[:-1], opened[-1]
    if not args.held_out:
        raise TgmError("train: --maps needs --held-out")
    if recipe.width_m != FRAME_WIDTH_M:
        raise TgmError(f"train: --width-m: expected {FRAME_WIDTH_M:g} with --maps, found {recipe.width_m:g}")
    scenes, unseen = ([load_map(path) for path in paths] for paths in (args.maps, args.held_out))
    night = Night(scenes, args.rendering_seed)
    held_out = RenderedPairs(unseen, night, args.held_out_pairs, recipe.seed + 1_000_000, recipe.size_px)
    return [RenderedPairs(scenes, night, args.pairs, recipe.seed, recipe.size_px)], held_out


def run_train(args: argparse.Namespace) -> None:
    """Training on pairs of any source, or on a made-up night over maps."""
    fields = {field.name for field in dataclasses.fields(Recipe)}
    recipe = Recipe(**{key: value for key, value in vars(args).items() if key in fields})
    sources, unseen = open_sources(args, recipe)
    *parts, validation = (
        AlignedPairs(source, usable_indices(source, args.max_black_px, quiet=False), recipe.size_px)
        for source in (*sources, unseen)
    )
    if not len(validation):
        raise TgmError(f"{unseen.name}: expected frames with at most {args.max_black_px} black pixels, found none")
    training = ConcatDataset(parts)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "command.txt").write_text("python -m sthn.tgm " + " ".join(args.words) + "\n")
    trainer = train(recipe, training, validation, args.out, args.device, args.workers)
    # What a painter who never looks at the satellite would do: the mean gray of the training frames.
    mean = torch.stack([training[i][1].mean() for i in range(min(200, len(training)))]).mean()
    flat = torch.stack([(validation[i][1] - mean).abs().mean() for i in range(len(validation))]).mean()
    own = torch.stack([(t - t.mean()).abs().mean() for t in (validation[i][1] for i in range(len(validation)))]).mean()
    facts = {
        "recipe": dataclasses.asdict(recipe),
        "rendering_seed": args.rendering_seed if args.maps else None,
        "training": {source.name: len(part) for source, part in zip(sources, parts, strict=True)},
        "held_out": {unseen.name: len(validation)},
        "seconds": round(trainer.spent_s),
        "held_out_l1": {"tgm": trainer.validate(validation)["val_l1"], "training_mean": float(flat), "own_mean": float(own)},
    }
    (args.out / "training.json").write_text(json.dumps(facts, indent=2) + "\n")
    print(json.dumps(facts["held_out_l1"]))


def run_generate(args: argparse.Namespace) -> None:
    """The extended set of a map, or its thermal as a map."""
    if (args.h5 is None) == (args.thermal_map is None):
        raise TgmError("generate: expected one of --h5 and --thermal-map")
    if args.h5 and args.map.suffix.lower() == ".png" and not args.exclude:
        raise TgmError(
            f"{args.map}: --exclude: expected published, none or r0,r1,c0,c1 for a map without coordinates, found none"
        )
    regions = [region for text in args.exclude for region in generate.excluded(text)]
    net = load_generator(args.checkpoint, args.tanh).to(args.device)
    kept = read(args.checkpoint).get("training", {}).get("recipe", {})
    size_px, width_m = args.size_px or kept.get("size_px", 512), args.width_m or kept.get("width_m", 512.0)
    if args.map.suffix.lower() == ".png":  # the published map: no georeference, 1 m/px
        with rasterio.open(args.map) as source:
            rgb, m_per_px = source.read([1, 2, 3]).transpose(1, 2, 0), 1.0
    else:
        rgb, m_per_px = read_rgb(args.map)
    if args.h5 and abs(m_per_px - 1) > generate.MAX_SCALE_ERROR:
        raise TgmError(
            f"{args.map}: expected 1 m/px within 2 % for --h5, found {m_per_px:.3f}: `gdalwarp -tr 1 1` in metres first"
        )
    # The published layout knows pixels only.
    tile_px = round(width_m if args.h5 else width_m / m_per_px)
    if min(rgb.shape[:2]) < tile_px:
        raise TgmError(f"{args.map}: expected at least {tile_px} px a side, found {rgb.shape[1]} x {rgb.shape[0]}")
    if args.h5:
        places = generate.write_extended(net, rgb, args.h5, tile_px, size_px, args.stride_px, regions, args.batch, args.device)
        if args.database:
            # Only the names of a database file are read: its windows are cropped from the map.
            boson.write(args.database, (np.zeros((8, 8), np.uint8) for _ in places), places)
        print(f"{len(places)} frames")
    else:
        gray = generate.thermal_of_map(net, rgb, tile_px, size_px, args.batch, args.device)
        generate.write_thermal_map(gray, args.map, args.thermal_map)


def main(words: list[str] | None = None) -> int:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.tgm", description=__doc__, formatter_class=raw)
    commands = parser.add_subparsers(required=True)
    default = Recipe()

    one = commands.add_parser("train", description=run_train.__doc__)
    one.set_defaults(run=run_train)
    one.add_argument("--data", type=Path, help="TOML with tables [[train]] and [held_out]")
    one.add_argument("--root", type=Path, help="what the paths of --data are relative to (default: its folder)")
    one.add_argument("--maps", type=Path, nargs="+", help="GeoTIFFs to train on, with a made-up night")
    one.add_argument("--held-out", type=Path, nargs="+", help="GeoTIFFs to validate on")
    one.add_argument("--rendering-seed", type=int, default=0, help="of the rule from ground to heat")
    one.add_argument("--pairs", type=int, default=2000)
    one.add_argument("--held-out-pairs", type=int, default=48)
    one.add_argument("--max-black-px", type=int, default=MAX_BLACK_PX, help="frames with more pixels of value 0 are removed")
    one.add_argument("--out", type=Path, required=True)
    for field in dataclasses.fields(Recipe):
        kind = float if isinstance(getattr(default, field.name), float) else int
        one.add_argument(f"--{field.name.replace('_', '-')}", type=kind, default=getattr(default, field.name))
    one.add_argument("--workers", type=int, default=0)

    two = commands.add_parser("generate", description=run_generate.__doc__)
    two.set_defaults(run=run_generate)
    two.add_argument("--checkpoint", type=Path, required=True)
    two.add_argument("--map", type=Path, required=True, help="a GeoTIFF, or the published PNG at 1 m/px")
    two.add_argument("--h5", type=Path, help="extended set in the published layout")
    two.add_argument(
        "--database", type=Path, help="with --h5: the file of window centres that its readers want, at the same places"
    )
    two.add_argument("--thermal-map", type=Path, help="GeoTIFF of the whole map's thermal")
    two.add_argument("--size-px", type=int, help="of the network's square; the checkpoint's, else 512")
    two.add_argument("--width-m", type=float, help="ground under it; the checkpoint's, else 512")
    two.add_argument("--stride-px", type=int, default=generate.STRIDE_PX)
    two.add_argument(
        "--exclude",
        action="append",
        default=[],
        help="ground of the tests, no frame's centre lies in it: r0,r1,c0,c1 (map rows and columns), published (of the published "
        "PNG) or none; again for more. A PNG needs it",
    )
    two.add_argument("--batch", type=int, default=16)
    two.add_argument("--tanh", action="store_true", help="the checkpoint was trained with a tanh at the end")
    for command in (one, two):
        command.add_argument("--device", default="cpu")

    args = parser.parse_args(words)
    args.words = sys.argv[1:] if words is None else words
    try:
        args.run(args)
    except (TgmError, DataError) as error:
        print(f"sthn.tgm: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
