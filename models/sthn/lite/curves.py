"""The curves of the light network's trainings, one picture.

    python -m sthn.lite.curves --training models/bundles/lite-1536/training --out models/reports/bar/curves.jpg

Training pairs, not held-out ones: loss and hits of the coarse stage, corner error of the refine stage, run after run.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def read(folder: Path) -> dict[str, list[float]]:
    """`curve-1.csv`, `curve-2.csv`, ..., `curve.csv` of a stage, one after the other; steps count on."""
    columns: dict[str, list[float]] = {}
    before = 0.0
    for path in [*sorted(folder.glob("curve-*.csv")), folder / "curve.csv"]:
        with path.open() as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            for name, value in row.items():
                columns.setdefault(name, []).append(float(value) + (before if name == "step" else 0.0))
        before = columns["step"][-1]
    return columns


def draw(training: Path, out: Path) -> None:
    """Both stages side by side."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), constrained_layout=True)
    coarse, refine = read(training / "coarse"), read(training / "refine")
    axes[0].plot(coarse["step"], coarse["hit_2_cells"], label="peak within 2 cells (11 m)")
    axes[0].plot(coarse["step"], coarse["own_map"], label="peak in the own map of the batch")
    axes[0].set(title="coarse stage", xlabel="step of 8 pairs", ylabel="share", ylim=(0, 1))
    axes[1].plot(refine["step"], refine["corner_m"], label="mean corner error")
    axes[1].plot(refine["step"], refine["median_m"], label="median corner error")
    axes[1].set(title="refine stage", xlabel="step of 8 pairs", ylabel="m", ylim=(0, None))
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


def main(words: list[str] | None = None) -> None:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="sthn.lite.curves", description=__doc__, formatter_class=raw)
    parser.add_argument("--training", type=Path, required=True, help="folder with coarse/ and refine/")
    parser.add_argument("--out", type=Path, required=True, help="picture")
    args = parser.parse_args(words)
    draw(args.training, args.out)


if __name__ == "__main__":
    main()
