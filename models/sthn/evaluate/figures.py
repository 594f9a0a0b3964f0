"""The paper's figures from stored results, one command each; nothing is run.

    python -m sthn.evaluate.figures tgm --with A --without B --method LABEL --out tgm.png      MACE by D_C, two trainings
    python -m sthn.evaluate.figures windows RESULTS ... --out windows.png                      MACE by D_C, a curve a method
    python -m sthn.evaluate.figures boxes --none A --widening B --full C --out boxes.jpg       the three box augmentations
    python -m sthn.evaluate.figures noise RESULTS --one LABEL --two LABEL --out noise.jpg      one stage fails, two succeed
    python -m sthn.evaluate.figures sheet RESULTS ... [--pick worst|best|first] --out sheet.jpg

RESULTS, A, B, C: a `results.json` or its folder. Sheets need `--pictures N` in the evaluation. Truth is green, the coarse
stage blue, the last one red.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from .pictures import COARSE, FINAL, Tile, save, sheet, tiles
from .quoted import MARK, paper
from .results import Condition, Results, ResultsError, noise_name
from .tables import Entry, gather, labels, may_quote

Curve = list[tuple[float, float]]


def curve(entries: list[Entry], label: str) -> Curve:
    """(D_C, MACE) of a method without noise."""
    own = [e for e in entries if e.label == label and e.condition.key[1] == "none" and e.cell.scores]
    points = ((e.condition.search_radius_m, e.cell.summary().mace_m) for e in own)
    return sorted((radius, mace) for radius, mace in points if mace is not None)


def draw_curves(curves: dict[str, Curve], out: Path, title: str, quoted: dict[str, Curve] | None = None) -> Path:
    """MACE over D_C, both logarithmic; quoted curves are dashed and say so."""
    if not any(curves.values()):
        raise ResultsError("curves: expected a method with scores without noise, found none")
    figure, axis = plt.subplots(figsize=(6.2, 4.2), layout="constrained")
    for label, points in curves.items():
        if points:
            axis.plot(*zip(*points, strict=True), marker="o", label=label)
    for label, points in (quoted or {}).items():
        axis.plot(*zip(*points, strict=True), marker="x", linestyle="--", alpha=0.6, label=f"{label} ({MARK})")
    radii = sorted({radius for points in [*curves.values(), *(quoted or {}).values()] for radius, _ in points})
    axis.set(xscale="log", yscale="log", xlabel="D_C (m)", ylabel="MACE (m)", title=title)
    axis.set_xticks(radii, [f"{r:g}" for r in radii])
    axis.minorticks_off()
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter("{x:g}")
    axis.grid(True, alpha=0.3)
    axis.legend(fontsize=8)
    return save(figure, out)


def tgm(with_tgm: Results, without: Results, method: str | None, out: Path) -> Path:
    """One method, trained with and without generated frames, on the same pairs."""
    curves = {}
    for results, name in ((with_tgm, "with TGM"), (without, "without TGM")):
        label = method or _only_method(results)
        curves[name] = curve(gather([results]), label)
    _check_same_pairs([with_tgm, without])
    return draw_curves(curves, out, f"TGM, {split_of(with_tgm)}")


def windows(many: list[Results], methods: Sequence[str], out: Path) -> Path:
    """A curve for each method (one for each W_S); the paper's beside them where the data is the paper's."""
    entries = gather(many)
    curves = {label: curve(entries, label) for label in methods or labels(entries)}
    quoted = None
    if may_quote(entries):
        table = paper()["table_1"]
        ours = [row for row in table["rows"] if row["method"].startswith("STHN")]
        quoted = {row["method"]: list(zip(table["search_radius_m"], row["mace_m"], strict=True)) for row in ours}
    return draw_curves(curves, out, f"W_S, {split_of(many[0])}", quoted)


BOXES = ("no augmentation", "widening only", "centre and widening")


def boxes(three: Sequence[Results], method: str | None, count: int, out: Path) -> Path:
    """The refinement under the three box augmentations: pictured pairs, and MACE of both stages below."""
    _check_same_pairs(three)
    rows = []
    for name, results in zip(BOXES, three, strict=True):
        condition, found = _pictured(results, method or _only_method(results))
        usable = [t for t in found if t.score.coarse is not None]
        rows.append([Tile(t.folder, t.record, t.score, name, t.window_m) for t in usable[:count]])
    bars = out.with_name(f"{out.stem}-stages.png")
    draw_stages({name: row for name, row in zip(BOXES, rows, strict=True)}, bars)
    return sheet(rows, out, f"box augmentation, {split_of(three[0])}, D_C {condition.search_radius_m:g} m")


def draw_stages(rows: dict[str, list[Tile]], out: Path) -> Path:
    """Corner error of the coarse and of the last stage over the pictured pairs, mean of each variant."""
    figure, axis = plt.subplots(figsize=(6.2, 3.4), layout="constrained")
    at = np.arange(len(rows))
    coarse = [_mean([corner_error(t.score.coarse, t) for t in row]) for row in rows.values()]
    final = [_mean([corner_error(t.score.quad, t) for t in row]) for row in rows.values()]
    axis.bar(at - 0.2, coarse, 0.4, color=COARSE, label="coarse")
    axis.bar(at + 0.2, final, 0.4, color=FINAL, label="final")
    axis.set_xticks(at, list(rows))
    axis.set(ylabel="mean corner error (m)", title=f"{min(len(r) for r in rows.values())} pictured pairs")
    axis.legend()
    return save(figure, out)


def corner_error(quad: list[list[float]] | None, tile: Tile) -> float | None:
    """Metres; quads are stored in metres."""
    if quad is None:
        return None
    return float(np.linalg.norm(np.array(quad) - np.array(tile.record.truth), axis=1).mean())


def noise(results: Results, one: str, two: str, count: int, out: Path) -> Path:
    """Under noise: pairs that the one-stage method loses by most where the two-stage one does not."""
    rows: tuple[list[Tile], list[Tile]] = ([], [])
    for index, condition in enumerate(results.conditions):
        if noise_name(condition.noise) == "none":
            continue
        for label, row in zip((one, two), rows, strict=True):
            cell = next((c for c in results.cells if c.method == label and c.condition == index and c.scores), None)
            if cell is None:
                raise ResultsError(f"{label}: expected scores under {noise_name(condition.noise)}, found none")
            row += tiles(results.folder, label, results.method(label).window_m, condition, cell)
    gain = [_lost(a) - _lost(b) for a, b in zip(*rows, strict=True)]
    order = np.argsort(gain)[::-1][:count]
    return sheet([[row[i] for i in order] for row in rows], out, "under noise: one stage, two stages")


def pictured(many: Sequence[Results], methods: Sequence[str], pick: str, count: int, out: Path) -> Path:
    """A row for each method, the same pairs below each other."""
    _check_same_pairs(many)
    found = {}
    for results in many:
        for method in results.methods:
            scored = any(cell.scores for _, cell in results.of(method.label))
            if scored and (not methods or method.label in methods):
                found[method.label] = _pictured(results, method.label)[1]
    if not found:
        raise ResultsError(f"sheet: expected one of the methods of the results, found {', '.join(methods) or 'none'}")
    least = min(len(row) for row in found.values())
    mean = np.array([np.mean([_lost(row[i]) for row in found.values()]) for i in range(least)])
    order = {"first": np.arange(least), "worst": np.argsort(mean)[::-1], "best": np.argsort(mean)}[pick][:count]
    return sheet([[row[i] for i in order] for row in found.values()], out, split_of(many[0]))


def _lost(tile: Tile) -> float:
    """Error to sort by: an unanswered pair is the worst."""
    return tile.score.corner_m if tile.score.corner_m is not None else 1e6


def _mean(values: Sequence[float | None]) -> float:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else float("nan")


def _pictured(results: Results, label: str) -> tuple[Condition, list[Tile]]:
    """The pictured pairs of a method, under its widest condition that has some."""
    best: tuple[Condition, list[Tile]] | None = None
    for condition, cell in results.of(label):
        found = tiles(results.folder, label, results.method(label).window_m, condition, cell) if cell.scores else []
        if found and (best is None or condition.search_radius_m > best[0].search_radius_m):
            best = condition, found
    if best is None:
        raise ResultsError(f"{label}: expected pictured pairs, found none: run the evaluation with --pictures N")
    return best


def _only_method(results: Results) -> str:
    if len(results.methods) != 1:
        found = ", ".join(m.label for m in results.methods)
        raise ResultsError(f"{results.folder}: --method: expected one of {found}, found none")
    return results.methods[0].label


def _check_same_pairs(many: Sequence[Results]) -> None:
    """Conditions of one name are of one digest; labels may repeat."""
    seen: dict[tuple, str] = {}
    for results in many:
        for condition in results.conditions:
            if seen.setdefault(condition.key, condition.digest) != condition.digest:
                raise ResultsError(
                    f"{results.folder}: D_C {condition.search_radius_m:g} m: expected the same pairs, found others"
                )


def split_of(results: Results) -> str:
    """What the pairs are of."""
    return str(results.source.get("name", "?"))


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m sthn.evaluate.figures", description=__doc__, formatter_class=raw)
    kinds = parser.add_subparsers(dest="figure", required=True)
    made = {name: kinds.add_parser(name) for name in ("tgm", "windows", "boxes", "noise", "sheet")}
    for sub in made.values():
        sub.add_argument("--out", type=Path, required=True)
    for name in ("windows", "sheet"):
        made[name].add_argument("results", type=Path, nargs="+")
        made[name].add_argument("--method", nargs="+", default=[], help="labels (default: all)")
    for name, options in (("tgm", ("with", "without")), ("boxes", ("none", "widening", "full"))):
        for option in options:
            made[name].add_argument(f"--{option}", type=Path, required=True, dest=f"of_{option}")
        made[name].add_argument("--method", help="label (default: the only one)")
    made["noise"].add_argument("results", type=Path)
    made["noise"].add_argument("--one", required=True)
    made["noise"].add_argument("--two", required=True)
    made["sheet"].add_argument("--pick", choices=["first", "worst", "best"], default="first")
    for name in ("boxes", "noise", "sheet"):
        made[name].add_argument("--pairs", type=int, default=4)
    o = parser.parse_args(arguments)
    try:
        if o.figure == "tgm":
            path = tgm(Results.read(o.of_with), Results.read(o.of_without), o.method, o.out)
        elif o.figure == "windows":
            path = windows([Results.read(p) for p in o.results], o.method, o.out)
        elif o.figure == "boxes":
            path = boxes([Results.read(p) for p in (o.of_none, o.of_widening, o.of_full)], o.method, o.pairs, o.out)
        elif o.figure == "noise":
            path = noise(Results.read(o.results), o.one, o.two, o.pairs, o.out)
        else:
            path = pictured([Results.read(p) for p in o.results], o.method, o.pick, o.pairs, o.out)
    except ResultsError as error:
        print(f"figures: {error}", file=sys.stderr)
        return 1
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
