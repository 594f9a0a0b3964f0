"""Commands on data sets.

    python -m sthn.data to-flight --folder DIR --split test --search-radius-m 512 --out FLIGHT [--limit 100]
    python -m sthn.data pairs --folder DIR --split test --search-radius-m 512 --out pairs.json

`to-flight`: an HDF5 split -> recorded-flight folder and GeoTIFF, then
`nightfix replay FLIGHT --map FLIGHT/map.tif --bundle B --out RESULTS`. `pairs`: which window each frame is sought in, to
be used again (`--pairs`).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .boson import SPLITS, open_split
from .to_flight import to_flight


def main(words: list[str] | None = None) -> int:
    """The command line; 2 for bad data."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.data", description=__doc__, formatter_class=raw)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("to-flight", "pairs"):
        command = commands.add_parser(name)
        command.add_argument("--folder", type=Path, required=True, help="with {split}_queries.h5 and {split}_database.h5")
        command.add_argument("--split", choices=SPLITS, default="test")
        command.add_argument("--map", type=Path, help="the big satellite map; default: the published place")
        command.add_argument("--search-radius-m", type=float, default=512.0, help="D_C")
        command.add_argument("--seed", type=int, default=0)
        command.add_argument("--pairs", type=Path, help="stored pairs instead of a draw")
        command.add_argument("--out", type=Path, required=True)
        if name == "to-flight":
            command.add_argument("--limit", type=int, help="at most so many frames")
    args = parser.parse_args(words)
    try:
        # The window's width does not enter: a flight has positions, and the service makes its own windows.
        pairs = open_split(
            args.folder, args.split, 512, args.search_radius_m, args.seed, args.map, pairs=args.pairs
        )  # fmt: skip
        if args.command == "pairs":
            pairs.chosen().save(args.out)
            print(f"{args.out}: {len(pairs)} pairs")
        else:
            print(f"{args.out}: {to_flight(pairs, args.out, args.limit)} frames")
    except (ValueError, OSError) as error:
        print(f"data: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
