"""Pictures of single pairs, small enough to be stored beside results, and the sheet that is drawn from them.

A sheet has a row for each method: the satellite window with the frame's outline where it is (truth, green), where the
coarse stage puts it (blue) and where the last stage does (red), as in the paper's figures; the thermal frame stands
beside its window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")  # no display is needed, and none is asked for
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from PIL import Image

from ..data import Pair
from .results import Cell, Condition, PairRecord, PairScore, Quad, ResultsError

TRUTH, COARSE, FINAL = "#00d000", "#2060ff", "#ff2020"
SATELLITE_PX, THERMAL_PX = 512, 192
JPEG_QUALITY = 85


def store(pair: Pair, folder: Path, stem: str) -> PairRecord:
    """Both pictures of a pair, in `folder`; the record that names them."""
    (folder / stem).parent.mkdir(parents=True, exist_ok=True)
    for kind, image, side in (("satellite", pair.satellite, SATELLITE_PX), ("thermal", pair.thermal, THERMAL_PX)):
        side = min(side, image.shape[0])
        small = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
        Image.fromarray(small).save(folder / f"{stem}-{kind}.jpg", quality=JPEG_QUALITY)
    truth = ((pair.quad() - (pair.satellite.shape[0] - 1) / 2) * pair.m_per_px).round(3).tolist()
    return PairRecord(pair.name, pair.terrain, truth, stem, pair.satellite.shape[0] * pair.m_per_px)


@dataclass(frozen=True)
class Tile:
    """One pair as one method saw it."""

    folder: Path
    """Of the results that it is from."""
    record: PairRecord
    score: PairScore
    label: str
    window_m: float
    """W_S: the part of the picture that is shown."""

    def image(self, kind: str) -> NDArray[np.uint8]:
        """The stored picture."""
        path = self.folder / f"{self.record.picture}-{kind}.jpg"
        try:
            return np.asarray(Image.open(path))
        except OSError as error:
            raise ResultsError(f"{path}: {error}") from error


def tiles(folder: Path | None, label: str, window_m: float, condition: Condition, cell: Cell) -> list[Tile]:
    """Every pictured pair of a cell."""
    if folder is None:
        raise ResultsError("pictures: expected results that were read from a folder, found none")
    zipped = zip(condition.pairs, cell.scores, strict=True)
    return [Tile(folder, pair, score, label, window_m) for pair, score in zipped if pair.picture and pair.truth]


def sheet(rows: Sequence[Sequence[Tile]], out: Path, title: str = "") -> Path:
    """A grid: a row for each list, a column for each pair; JPEG or PNG by the file's name."""
    if not rows or not any(rows):
        raise ResultsError("sheet: expected at least one pictured pair, found none: run the evaluation with --pictures N")
    columns = max(len(row) for row in rows)
    figure, axes = plt.subplots(
        len(rows), 2 * columns, figsize=(3.9 * columns, 2.75 * len(rows) + 0.5), squeeze=False,
        width_ratios=[2.2, 1.0] * columns, layout="constrained",
    )  # fmt: skip
    for axis in axes.flat:
        axis.set_axis_off()
    for row, drawn in zip(axes, rows, strict=True):
        for column, tile in enumerate(drawn):
            _draw(row[2 * column], tile)
            row[2 * column + 1].imshow(tile.image("thermal"), cmap="gray", vmin=0, vmax=255)
    lines = [plt.Line2D([], [], color=c, label=n) for c, n in ((TRUTH, "truth"), (COARSE, "coarse"), (FINAL, "final"))]
    figure.legend(handles=lines, loc="outside lower center", ncols=3, frameon=False)
    if title:
        figure.suptitle(title)
    return save(figure, out)


def _draw(axis: Axes, tile: Tile) -> None:
    assert tile.record.picture_width_m is not None
    half = tile.record.picture_width_m / 2
    axis.imshow(tile.image("satellite"), extent=(-half, half, half, -half))
    # The thickest first: where all agree each is still seen.
    for quad, colour, width in ((tile.record.truth, TRUTH, 3.6), (tile.score.coarse, COARSE, 2.2), (tile.score.quad, FINAL, 1.2)):
        if quad is not None:
            outline(axis, quad, colour, width)
    shown = min(tile.window_m, tile.record.picture_width_m) / 2
    axis.set(xlim=(-shown, shown), ylim=(shown, -shown))
    error = "no answer" if tile.score.corner_m is None else f"{tile.score.corner_m:.1f} m"
    axis.set_title(f"{tile.label}: {error}", fontsize=8)


def outline(axis: Axes, quad: Quad, colour: str, width: float) -> None:
    """TL, TR, BL, BR as a closed line."""
    ring = np.array([quad[i] for i in (0, 1, 3, 2, 0)])
    axis.plot(ring[:, 0], ring[:, 1], color=colour, linewidth=width)


def save(figure: plt.Figure, out: Path) -> Path:
    """By the ending of its name; closed afterwards."""
    out.parent.mkdir(parents=True, exist_ok=True)
    jpeg = {"pil_kwargs": {"quality": 80}} if out.suffix.lower() in (".jpg", ".jpeg") else {}
    figure.savefig(out, dpi=100, **jpeg)
    plt.close(figure)
    return out
