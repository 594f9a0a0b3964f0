"""`python -m sthn.evaluate SOURCE --method ... --out DIR`: every method on the same pairs; scores, tables, pictures.

    python -m sthn.evaluate maps:maps/demo --pairs 100 --method bundle:models/bundles/lite-1536 rival:identity --out out/demo
    python -m sthn.evaluate boson:datasets/v3,split=test --radius-m 50 64 128 256 512 --method rival:sift+magsac \\
        "STHN W_S = 512=checkpoint:runs/512-dc{dc}.pth,window=512,levels=2" --out out/table-1
    python -m sthn.evaluate flight:flights/a,map=a.tif --noise none rotation=10 scale=0.1 --method bundle:B --out out/table-3

SOURCE is KIND:WHAT[,KEY=VALUE ...], or a TOML file with a `[source]` table (`sthn.data.spec`): `boson` a folder in the
published HDF5 layout, `maps` georeferenced maps with synthetic thermal frames (folder, or files joined by `+`), `flight` a
recorded flight with truth. Methods: see `sthn.evaluate.methods`. Every D_C is run under every noise.

DIR gets `results.json` (every score; tables and figures are made from it), `tables.md`, one `.md` and `.csv` a table, and
`pictures/` of the first pairs of each condition. The paper's own numbers are printed, marked "quoted", where SOURCE is the
paper's test split and nowhere else.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any

import torch

from ..data import FRAME_PX, DataError, PairSource, open_source
from ..data.spec import COMMON, KEYS, Part
from . import methods, run, tables

WHAT = {"boson": "folder", "maps": "maps", "flight": "folder"}
"""The key that a source's WHAT stands for."""

SET_HERE = ("kind", "window_m", "search_radius_m", "seed", "count", "noise")
"""Keys that the evaluation sets itself."""


def parse_source(text: str) -> dict[str, Any]:
    """The table of a source, without what the evaluation sets."""
    if text.endswith(".toml"):
        try:
            table = tomllib.loads(Path(text).read_text(encoding="utf-8")).get("source")
        except (OSError, ValueError) as error:
            raise DataError(text, "file", "a readable TOML file", error) from error
        if not isinstance(table, dict):
            raise DataError(text, "source", "a table", "nothing")
        return {key: value for key, value in table.items() if key == "kind" or key not in SET_HERE}
    kind, colon, rest = text.partition(":")
    if not colon or kind not in WHAT:
        raise DataError("SOURCE", text, f"KIND:WHAT with KIND one of {', '.join(WHAT)}, or a .toml file", "another")
    what, *more = rest.split(",")
    table: dict[str, Any] = {"kind": kind, WHAT[kind]: what.split("+") if kind == "maps" else what}
    known = {k: t for k, t in (COMMON | KEYS[kind]).items() if k not in SET_HERE}
    for word in more:
        key, equals, value = word.partition("=")
        if key not in known or not equals:
            raise DataError("SOURCE", key, f"KEY=VALUE with KEY one of {', '.join(sorted(known))}", word)
        try:
            table[key] = value == "true" if known[key] is bool else known[key](value)
        except ValueError as error:
            raise DataError("SOURCE", key, known[key].__name__, value) from error
    return table


def opener(table: dict[str, Any], seed: int, count: int | None, surround: bool) -> run.OpenPairs:
    """How a condition opens its pairs. Frames are made alike with and without noise."""
    common = {"seed": seed} | ({"count": count} if count is not None else {})
    if table["kind"] in ("maps", "flight") and surround:
        common["surround"] = True

    def open_pairs(window_px: int, radius_m: float) -> PairSource:
        return open_source(common | table | {"window_m": window_px, "search_radius_m": radius_m}, "SOURCE")

    return open_pairs


def describe(table: dict[str, Any], pairs: PairSource) -> dict[str, Any]:
    """What results say of their source; `queries` decides, with kind and split, whether it is the paper's."""
    inner = pairs.source if isinstance(pairs, Part) else pairs
    found = {"name": pairs.name, **{k: v for k, v in table.items() if k != "name"}}
    if hasattr(inner, "queries"):
        found["queries"] = len(inner.queries)
    return found


def parser() -> argparse.ArgumentParser:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    made = argparse.ArgumentParser(prog="python -m sthn.evaluate", description=__doc__, formatter_class=raw)
    made.add_argument("source", help="KIND:WHAT[,KEY=VALUE ...] or a TOML file")
    made.add_argument("--method", nargs="+", required=True, help="[LABEL=]KIND:WHAT[,OPTION=VALUE ...]")
    made.add_argument("--radius-m", type=float, nargs="+", default=[512.0], help="D_C (default: 512)")
    made.add_argument("--noise", nargs="+", default=["none"], help="none, rotation=DEG, scale=SHARE, perspective=PX")
    made.add_argument("--pairs", type=int, help="at most so many a condition, evenly spaced; `maps` needs it")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--pictures", type=int, default=0, help="pairs a condition whose pictures and outlines are stored")
    made.add_argument("--threads", type=int, default=1, help="of PyTorch; bundles run on one")
    made.add_argument("--device", default="cpu", help="of checkpoints: cpu, cuda, cuda:1; bundles and rivals run on the CPU")
    made.add_argument("--out", type=Path, required=True)
    return made


def main(arguments: list[str] | None = None) -> int:
    """The command; 0, or 2 where something was asked for wrongly."""
    words = sys.argv[1:] if arguments is None else arguments
    options = parser().parse_args(words)
    torch.set_num_threads(options.threads)
    try:
        table = parse_source(options.source)
        noises = [run.parse_noise(text) for text in options.noise]
        specs = methods.parse_all(options.method)
        open_pairs = opener(table, options.seed, options.pairs, any(noise.kinds for noise in noises))
        source = describe(table, open_pairs(FRAME_PX, options.radius_m[0])) | {"seed": options.seed}
        plan = run.Plan(specs, options.radius_m, noises, options.seed, options.pictures, options.device)
        results = run.run(plan, open_pairs, source, options.out, "python -m sthn.evaluate " + shlex.join(words))
        made = tables.tables([results])
    except (ValueError, OSError) as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 2
    tables.write(made, options.out, results.command)
    print("\n".join(table.markdown() for table in made.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
