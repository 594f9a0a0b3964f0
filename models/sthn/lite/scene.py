"""Maps to train on, and the geometry of a training pair.

All training geometry lives here: which ground, turned and mirrored how, with which homography between the frame and
the map. A pair is drawn in metres of the (zoomed) map, so that 1 m here need not be 1 m there: that is the scale
augmentation of both images together.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio

# Loaders fork: a pool of OpenCV threads in the parent would leave the child waiting for ever.
cv2.setNumThreads(0)


@dataclass
class SceneMap:
    """A map in memory: an area pyramid of RGB (level k is 2^k times coarser), with classes where known."""

    name: str
    m_per_px: float
    levels: list[np.ndarray]
    later: list[list[np.ndarray]]  # pyramids of the same ground on other dates, from which a frame may be made
    classes: np.ndarray | None
    valid: np.ndarray  # bool, level 0

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of level 0."""
        return self.levels[0].shape[:2]


def pyramid(rgb: np.ndarray, count: int = 5) -> list[np.ndarray]:
    """An area pyramid."""
    levels = [np.ascontiguousarray(rgb)]
    while len(levels) < count and min(levels[-1].shape[:2]) >= 64:
        h, w = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1][: h // 2 * 2, : w // 2 * 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA))
    return levels


def read_rgb(path: Path, columns: slice = slice(None)) -> tuple[np.ndarray, float]:
    """RGB of a georeferenced map and its metres per pixel (projected metres; Web Mercator corrected)."""
    with rasterio.open(path) as source:
        rgb = np.moveaxis(source.read([1, 2, 3]), 0, -1)
        m_per_px = abs(source.transform.a)
        if source.crs.to_epsg() == 3857:
            y = source.transform.f + source.transform.e * source.height / 2
            m_per_px *= 1.0 / np.cosh(y / 6378137.0)
        elif source.crs.is_geographic:
            m_per_px *= 111319.49 * np.cos(np.radians(source.transform.f))
    return np.ascontiguousarray(rgb[:, columns]), float(m_per_px)


def load_map(path: Path, later: tuple[Path, ...] = (), columns: slice = slice(None)) -> SceneMap:
    """Loads a map, its `_classes.tif` where there is one, and the same ground on other dates."""
    rgb, m_per_px = read_rgb(path, columns)
    classes_path = path.with_name(path.stem + "_classes.tif")
    classes = None
    if classes_path.exists():
        with rasterio.open(classes_path) as source:
            classes = np.ascontiguousarray(source.read(1)[:, columns])
    valid = rgb.any(axis=2)
    others = [pyramid(read_rgb(p, columns)[0]) for p in later]
    return SceneMap(path.stem, m_per_px, pyramid(rgb), others, classes, valid)


@dataclass(frozen=True)
class PairNoise:
    """Bounds of the homography between a frame and where it is assumed to lie. Uniform, both signs."""

    shift_m: float
    rotation_deg: float
    scale: float
    perspective_m: float


def similarity(cx: float, cy: float, angle_rad: float, scale: float, mirror: bool) -> np.ndarray:
    """3 x 3: turns (clockwise with y down), scales and mirrors about the origin, then moves to (cx, cy)."""
    c, s = np.cos(angle_rad) * scale, np.sin(angle_rad) * scale
    m = -1.0 if mirror else 1.0
    return np.array([[c * m, -s, cx], [s * m, c, cy], [0.0, 0.0, 1.0]])


def frame_to_map_m(noise: PairNoise, frame_width_m: float, rng: np.random.Generator) -> np.ndarray:
    """Homography from frame metres (centred, x right, y down) to metres about the assumed place."""
    half = frame_width_m / 2
    corners = np.array([[-half, -half], [half, -half], [-half, half], [half, half]])
    turned = similarity(
        rng.uniform(-noise.shift_m, noise.shift_m),
        rng.uniform(-noise.shift_m, noise.shift_m),
        np.radians(rng.uniform(-noise.rotation_deg, noise.rotation_deg)),
        1.0 + rng.uniform(-noise.scale, noise.scale),
        False,
    )
    to = corners @ turned[:2, :2].T + turned[:2, 2] + rng.uniform(-noise.perspective_m, noise.perspective_m, (4, 2))
    return cv2.getPerspectiveTransform(corners.astype(np.float32), to.astype(np.float32)).astype(np.float64)


def px_to_m(size_px: int, width_m: float) -> np.ndarray:
    """3 x 3: pixel of a centred square -> metres from its middle."""
    m = width_m / size_px
    return np.array([[m, 0.0, -(size_px - 1) / 2 * m], [0.0, m, -(size_px - 1) / 2 * m], [0.0, 0.0, 1.0]])


def cut(levels: list[np.ndarray], to_map_px: np.ndarray, size_px: int, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Samples a square through `to_map_px` (output pixel -> level-0 pixel), from the level that does not alias."""
    middle = to_map_px @ np.array([(size_px - 1) / 2, (size_px - 1) / 2, 1.0])
    step = np.sqrt(abs(np.linalg.det(to_map_px[:2, :2]))) / abs(middle[2])
    level = int(np.clip(np.floor(np.log2(max(step, 1e-6)) + 0.35), 0, len(levels) - 1))
    scale = 0.5**level
    down = np.array([[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0.0, 0.0, 1.0]])
    return cv2.warpPerspective(
        levels[level],
        down @ to_map_px,
        (size_px, size_px),
        flags=interpolation | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
