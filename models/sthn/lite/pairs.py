"""Training pairs for both light stages, drawn on the fly, seeded."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from . import thermal
from .scene import PairNoise, SceneMap, cut, frame_to_map_m, px_to_m, similarity

FRAME_WIDTH_M = 512.0


@dataclass(frozen=True)
class PairSpec:
    """What a stage sees in training."""

    map_px: int
    map_width_m: float
    frame_px: int  # the frame as rendered; the stage's input is `frame_px / frame_reduce`
    frame_reduce: int
    noise: PairNoise


COARSE = PairSpec(256, 256 * 16 / 3, 192, 2, PairNoise(418.0, 5.5, 0.075, 10.0))
REFINE = PairSpec(240, 640.0, 192, 1, PairNoise(22.0, 8.0, 0.08, 14.0))


class Pairs(IterableDataset):
    """An endless stream of pairs: map f32 `[3, n, n]`, frame f32 `[2, m, m]`, homography frame metres -> map metres."""

    def __init__(self, scenes: list[SceneMap], spec: PairSpec, seed: int, start: int = 0):
        self.scenes, self.spec, self.seed, self.start = scenes, spec, seed, start
        areas = np.array([min(s.size[0] * s.size[1] * s.m_per_px**2, 12e6) for s in scenes])
        self.share = areas / areas.sum()

    def __iter__(self):
        worker = get_worker_info()
        index = self.start + (worker.id if worker else 0)
        stride = worker.num_workers if worker else 1
        while True:
            yield self.pair(index)
            index += stride

    def pair(self, index: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The pair with this number: the same for the same seed, whatever was drawn before."""
        rng = np.random.default_rng([self.seed, index])
        for _ in range(20):
            drawn = self.draw(rng)
            if drawn is not None:
                return drawn
        raise RuntimeError(f"no pair with enough map in 20 trials (seed {self.seed}, pair {index})")

    def draw(self, rng: np.random.Generator):
        spec = self.spec
        scene = self.scenes[int(rng.choice(len(self.scenes), p=self.share))]
        zoom = np.exp(rng.uniform(np.log(0.7), np.log(1.4)))  # map metres per training metre
        if scene.m_per_px > 3.0:
            zoom = np.exp(rng.uniform(np.log(0.9), np.log(2.0)))
        step = zoom / scene.m_per_px
        h, w = scene.size
        reach = min(0.35 * spec.map_width_m * step, 0.5 * min(h, w) - 1)
        centre = (rng.uniform(reach, w - reach), rng.uniform(reach, h - reach))
        angle = rng.integers(0, 4) * np.pi / 2 + (rng.uniform(-np.pi / 4, np.pi / 4) if rng.random() < 0.6 else 0.0)
        ground = similarity(*centre, angle, step, bool(rng.random() < 0.5))
        relation = frame_to_map_m(spec.noise, FRAME_WIDTH_M, rng)

        to_map = ground @ px_to_m(spec.map_px, spec.map_width_m)
        to_frame = ground @ relation @ px_to_m(spec.frame_px, FRAME_WIDTH_M)
        levels = scene.levels
        if scene.later and rng.random() < 0.6:
            levels = scene.later[int(rng.integers(0, len(scene.later)))]
        seen = cut(levels, to_frame, spec.frame_px)
        if (thermal.brightest(seen) > 0).mean() < 0.9:
            return None
        picture = cut(scene.levels, to_map, spec.map_px)
        classes = None
        if scene.classes is not None:
            classes = cv2.warpPerspective(
                scene.classes, to_frame, (spec.frame_px, spec.frame_px), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            )
        gray = self.gray(scene, seen, classes, to_frame, rng).astype(np.float32)
        mask = self.mask(rng)
        if spec.frame_reduce > 1:
            size = (spec.frame_px // spec.frame_reduce,) * 2
            gray = cv2.resize(gray * mask, size, interpolation=cv2.INTER_AREA)
            share = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
            gray, mask = gray / np.maximum(share, 1e-3), (share >= 0.5).astype(np.float32)
        frame = np.stack([gray * mask, mask]).astype(np.float32)
        colour = thermal.colour_jitter(picture, rng) * (thermal.brightest(picture) > 0)[..., None]
        image = np.ascontiguousarray(np.moveaxis(colour, -1, 0), dtype=np.float32)
        return torch.from_numpy(image), torch.from_numpy(frame), torch.from_numpy(relation)

    def gray(
        self, scene: SceneMap, seen: np.ndarray, classes: np.ndarray | None, to_frame: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """The frame `[n, n]` in 0..1 over what the camera looks at: colours and classes, or through `to_frame` (frame
        pixel -> level-0 map pixel) anything else that is known of the map."""
        m_per_px = FRAME_WIDTH_M / self.spec.frame_px
        return thermal.sensor(thermal.render(seen, classes, m_per_px, rng), m_per_px, rng)

    def mask(self, rng: np.random.Generator) -> np.ndarray:
        """What the sensor saw of the square: all of it, or a turned rectangle that leaves corners unseen."""
        n = self.spec.frame_px
        mask = np.ones((n, n), np.float32)
        if rng.random() < 0.4:
            sides = rng.uniform(0.85, 1.35, 2) * n
            middle = (n / 2 + rng.normal(0, 0.03 * n), n / 2 + rng.normal(0, 0.03 * n))
            box = cv2.boxPoints((middle, (float(sides[0]), float(sides[1])), rng.uniform(0, 90)))
            mask[:] = 0
            cv2.fillPoly(mask, [np.round(box).astype(np.int32)], 1.0)
        return mask
