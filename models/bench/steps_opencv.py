"""The steps around the networks in OpenCV, on one thread: the bar for nightfix's own."""

import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import rasterio


class Clock:
    """Milliseconds by step."""

    def __init__(self) -> None:
        self.taken_ms: dict[str, float] = {}

    def __call__(self, step: str, work: Callable, *arguments):
        """Runs `work` and books its time under `step`."""
        start = time.perf_counter()
        result = work(*arguments)
        self.taken_ms[step] = self.taken_ms.get(step, 0.0) + (time.perf_counter() - start) * 1e3
        return result


def decode(data: np.ndarray) -> np.ndarray:
    """PNG -> 16-bit samples."""
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


def tone(frame: np.ndarray) -> np.ndarray:
    """A percentile stretch, as OpenCV and numpy offer it."""
    counts = np.cumsum(cv2.calcHist([frame], [0], None, [1 << 16], [0, 1 << 16]))
    lo, hi = np.searchsorted(counts, [frame.size // 200, frame.size - frame.size // 200])
    scale = 255.0 / max(int(hi) - int(lo), 64)
    return cv2.convertScaleAbs(np.maximum(frame, lo), alpha=scale, beta=-float(lo) * scale)


def rectify(frame: np.ndarray, gsd_m: float, yaw_deg: float, side: int) -> np.ndarray:
    """North-up square at 1 m/px, nadir."""
    sin, cos = np.sin(np.radians(yaw_deg)) / gsd_m, np.cos(np.radians(yaw_deg)) / gsd_m
    middle = (side - 1) / 2
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    back, forth = np.eye(3), np.eye(3)
    back[:2, 2] = -middle
    forth[:2, 2] = (frame.shape[1] - 1) / 2, (frame.shape[0] - 1) / 2
    return cv2.warpPerspective(frame, forth @ turn @ back, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def window(picture: np.ndarray, map_from_window: np.ndarray, side: int) -> np.ndarray:
    """A metric window of a map that lies decoded in memory: RGB, bilinear."""
    corners = map_from_window @ np.array([[0, side, 0, side], [0, 0, side, side], [1, 1, 1, 1]])
    low = np.clip(np.floor(corners.min(1)).astype(int) - 2, 0, None)
    high = np.clip(np.ceil(corners.max(1)).astype(int) + 3, 0, picture.shape[1::-1])
    part = picture[low[1] : high[1], low[0] : high[0]]
    inner = map_from_window - np.array([[0, 0, low[0]], [0, 0, low[1]]])
    return cv2.warpAffine(part, inner, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def crop(window_rgb: np.ndarray, window_from_crop: np.ndarray, size_px: int, samples: int) -> np.ndarray:
    """A turned square of the window, `samples` x `samples` bilinear samples a pixel, planar f32 in 0..1."""
    fine = window_from_crop.copy()
    fine[:, :2] /= samples
    # Fine pixel (i, j) is sample i % samples of crop pixel i // samples.
    fine[:, 2] -= window_from_crop[:, :2] @ np.full(2, (samples - 1) / (2 * samples))
    side = size_px * samples
    turned = cv2.warpAffine(window_rgb, fine, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    if samples > 1:
        turned = cv2.resize(turned, (size_px, size_px), interpolation=cv2.INTER_AREA)
    return cv2.dnn.blobFromImage(turned, 1 / 255.0)


def dlt(frame_edges: np.ndarray, window_edges: np.ndarray) -> np.ndarray:
    """Four corners -> homography."""
    return cv2.getPerspectiveTransform(frame_edges.astype(np.float32), window_edges.astype(np.float32))


class Map:
    """The map, decoded once: a warm cache."""

    def __init__(self, path: Path) -> None:
        with rasterio.open(path) as source:
            self.picture = np.ascontiguousarray(np.moveaxis(source.read([1, 2, 3]), 0, -1))
            self.pixel_from_crs = np.array((~source.transform)[:6]).reshape(2, 3)

    def pixel_from_window(self, map_affine: list[float], margin_px: int) -> np.ndarray:
        """Affine from pixels of the window with its margin to pixels of the map, an integer being a pixel's centre."""
        crs_from_window = np.vstack([np.array(map_affine).reshape(2, 3), [0, 0, 1]])
        crs_from_window[:2, 2] -= crs_from_window[:2, :2] @ np.full(2, margin_px)
        affine = self.pixel_from_crs @ crs_from_window
        affine[:, 2] -= 0.5  # the transform's integers are corners
        return affine


def crop_grid(manifest: dict, homography: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Affine from crop pixels to window pixels (with margin), crop side, samples a pixel."""
    spec, margin = manifest["refine"]["map"], manifest["window_margin_m"]
    size_px, m_per_px = spec["size_px"], spec["width_m"] / spec["size_px"]
    middle = (manifest["frame_width_m"] - 1) / 2
    offset = (size_px - 1) / 2
    linear = homography[:2, :2] * m_per_px
    shift = homography[:2] @ np.array([middle, middle, 1.0]) + margin - linear @ np.full(2, offset)
    samples = max(1, round(m_per_px)) if spec["resize"] == "supersample" else 1
    return np.column_stack([linear, shift]), size_px, samples


def run(data: bytes, row: dict, fix: dict, picture: Map, manifest: dict) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """All steps of one frame: milliseconds, the window and the crop. `fix` is nightfix's own answer for this frame."""
    clock = Clock()
    side = int(manifest["frame_width_m"])
    raw = clock("decode", decode, np.frombuffer(data, np.uint8))
    toned = clock("tone", tone, raw)
    clock("rectify", rectify, toned, row["gsd_m"], row["yaw_deg"], side)
    margin_px = int(manifest["window_margin_m"])
    affine = picture.pixel_from_window(fix["window"]["map_affine"], margin_px)
    window_rgb = clock("window", window, picture.picture, affine, int(manifest["window_width_m"]) + 2 * margin_px)
    homography = np.array(fix["homography"])
    edges = np.array([[-0.5, -0.5], [side - 0.5, -0.5], [-0.5, side - 0.5], [side - 0.5, side - 0.5]])
    to = np.column_stack([edges, np.ones(4)]) @ homography.T
    blob = None
    if "refine" in manifest:
        blob = clock("crop", crop, window_rgb, *crop_grid(manifest, homography))
    clock("dlt", dlt, edges, to[:, :2] / to[:, 2:])
    return clock.taken_ms, window_rgb, blob


def manifest_of(bundle: Path) -> dict:
    """A bundle's manifest."""
    return tomllib.loads((bundle / "bundle.toml").read_text())
