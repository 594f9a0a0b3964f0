"""Frames for the light networks' training that the TGM painted, and frames of the night that it learnt from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio

from ..lite import thermal
from ..lite.pairs import FRAME_WIDTH_M, Pairs, PairSpec
from ..lite.scene import SceneMap, cut, pyramid
from .checkpoint import TgmError
from .rendered import Night


def load_generated(folder: Path, scenes: list[SceneMap]) -> dict[str, list[np.ndarray]]:
    """Pyramids of the thermal maps in `folder`, `<map>.tif` each, of the scenes that have one."""
    found = {}
    for scene in scenes:
        path = folder / f"{scene.name}.tif"
        if not path.exists():
            continue
        with rasterio.open(path) as source:
            # A scene may be the first columns of its file.
            gray = source.read(1)[:, : scene.size[1]]
        if gray.shape != scene.size:
            raise TgmError(
                f"{path}: expected {scene.size[1]} x {scene.size[0]} px as its map, found {gray.shape[1]} x {gray.shape[0]}"
            )
        found[scene.name] = pyramid(gray)
    if not found:
        raise TgmError(f"{folder}: expected at least one of {', '.join(f'{scene.name}.tif' for scene in scenes)}, found none")
    return found


class PairsWithGenerated(Pairs):
    """Training pairs of which a share has a painted frame; the sensor's faults are drawn for both kinds."""

    def __init__(
        self,
        scenes: list[SceneMap],
        spec: PairSpec,
        seed: int,
        start: int,
        generated: dict[str, list[np.ndarray]],
        share: float,
    ) -> None:
        super().__init__(scenes, spec, seed, start)
        if not 0 <= share <= 1:
            raise TgmError(f"generated share: expected 0 to 1, found {share}")
        self.generated, self.generated_share = generated, share

    def gray(self, scene, seen, classes, to_frame, rng) -> np.ndarray:
        levels = self.generated.get(scene.name)
        if levels is None or rng.random() >= self.generated_share:
            return super().gray(scene, seen, classes, to_frame, rng)
        painted = thermal.unit(cut(levels, to_frame, self.spec.frame_px).astype(np.float32))
        return thermal.sensor(painted, FRAME_WIDTH_M / self.spec.frame_px, rng)


class NightPairs(Pairs):
    """Pairs with frames of one night, as the TGM's real frames are: to evaluate on."""

    def __init__(self, scenes: list[SceneMap], spec: PairSpec, seed: int, night: Night) -> None:
        super().__init__(scenes, spec, seed)
        self.night = night

    def gray(self, scene, seen, classes, to_frame, rng) -> np.ndarray:
        return self.night.render(seen, classes, FRAME_WIDTH_M / self.spec.frame_px, rng) / 255
