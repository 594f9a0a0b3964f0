"""A made-up night over real maps: one fixed rule from ground to heat, so that there is something to learn.

The renderer of the light networks' training (`sthn.lite.thermal`) draws another rule for every frame, so that none can
be learnt; here materials, their temperatures and the classes' offsets are drawn once, and only the sensor's noise
changes from frame to frame. It stands for the one camera and the one season of a recorded data set.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.pair import Pair
from ..lite.scene import SceneMap, cut, similarity

MATERIALS = 10
FRAME_WIDTH_M = 512.0
NOISE = 0.08
"""Of the sensor, in standard deviations of the scene."""


class Night:
    """The rule: colours of the scenes' materials, a temperature for each, an offset for each class."""

    def __init__(self, scenes: Sequence[SceneMap], seed: int) -> None:
        rng = np.random.default_rng(seed)
        pixels = [scene.levels[min(2, len(scene.levels) - 1)].reshape(-1, 3) for scene in scenes]
        colours = np.concatenate([p[rng.integers(0, len(p), 4000)] for p in pixels])
        colours = colours[colours.any(1)].astype(np.float32) / 255
        self.centres = colours[rng.integers(0, len(colours), MATERIALS)]
        self.temperature = rng.standard_normal(MATERIALS).astype(np.float32)
        self.offsets = (0.8 * rng.standard_normal(256)).astype(np.float32)
        self.detail = float(rng.choice([-0.5, 0.5]))
        values = self._material(colours)
        self.mean, self.std = float(values.mean()), max(float(values.std()), 1e-3)

    def _material(self, colours: NDArray[np.float32]) -> NDArray[np.float32]:
        """`[N, 3]` -> temperatures `[N]`: colours belong softly to the nearest materials."""
        distance = (self.centres**2).sum(1)[:, None] - 2 * self.centres @ colours.T
        weight = np.exp((distance.min(0) - distance) / (2 * 0.06**2))
        return (self.temperature @ weight) / weight.sum(0)

    def render(
        self, rgb8: NDArray[np.uint8], classes: NDArray[np.uint8] | None, m_per_px: float, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """uint8 RGB `[n, n, 3]`, classes `[n, n]` -> an 8-bit frame `[n, n]`; `rng` is the sensor's noise only. A
        temperature has the same gray in every frame."""
        n = rgb8.shape[0]
        rgb = rgb8.astype(np.float32) / 255
        heat = (self._material(rgb.reshape(-1, 3)).reshape(n, n) - self.mean) / self.std
        gray = rgb.mean(2)
        detail = gray - cv2.GaussianBlur(gray, (0, 0), 16 / m_per_px)
        heat = heat + self.detail * detail / 0.06
        if classes is not None:
            heat = heat + cv2.blur(self.offsets[classes], (3, 3))
        heat = cv2.GaussianBlur(heat, (0, 0), 2 / m_per_px)
        heat = heat + NOISE * rng.standard_normal((n, n)).astype(np.float32)
        return np.clip(128 + 45 * heat, 1, 255).astype(np.uint8)


class RenderedPairs:
    """A `PairSource` of aligned pairs over maps: the window is the frame's square, turned by quarters and mirrored.

    Images have `size_px` pixels over 512 m. Pair `index` depends on the seed and the index alone.
    """

    search_radius_m = 0.0

    def __init__(self, scenes: Sequence[SceneMap], night: Night, count: int, seed: int, size_px: int = 512) -> None:
        self.scenes, self.night, self.count, self.seed, self.size_px = list(scenes), night, count, seed, size_px
        self.name = "+".join(scene.name for scene in scenes)
        self.window_m = int(FRAME_WIDTH_M)
        areas = np.array([scene.size[0] * scene.size[1] * scene.m_per_px**2 for scene in scenes])
        self.share = areas / areas.sum()

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Pair:
        if not 0 <= index < self.count:
            raise IndexError(f"{self.name}: pair {index} of {self.count}")
        rng = np.random.default_rng([self.seed, index])
        for _ in range(50):
            scene = self.scenes[int(rng.choice(len(self.scenes), p=self.share))]
            h, w = scene.size
            step = FRAME_WIDTH_M / self.size_px / scene.m_per_px
            half = min(FRAME_WIDTH_M / 2 / scene.m_per_px, (min(h, w) - 1) / 2)
            ground = similarity(
                rng.uniform(half, w - half), rng.uniform(half, h - half), rng.integers(0, 4) * np.pi / 2, step, rng.random() < 0.5
            )
            middle = (self.size_px - 1) / 2
            ground = ground @ np.array([[1.0, 0.0, -middle], [0.0, 1.0, -middle], [0.0, 0.0, 1.0]])
            satellite = cut(scene.levels, ground, self.size_px)
            if satellite.any(axis=2).mean() >= 0.99:
                break
        else:
            raise RuntimeError(f"{self.name}: pair {index}: no place with enough map in 50 trials (seed {self.seed})")
        classes = None
        if scene.classes is not None:
            flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            classes = cv2.warpPerspective(scene.classes, ground, (self.size_px, self.size_px), flags=flags)
        thermal = self.night.render(satellite, classes, FRAME_WIDTH_M / self.size_px, rng)
        return Pair(f"{self.name}-{self.seed}-{index:06d}", satellite, thermal, np.eye(3))
