"""The correlation stage and the oriented crop: what `src/locate` does, in numpy, for bundles of kind `correlation`.

Everything here is outside the graphs: frame hypotheses, dense correlation, posterior over the search disc, sub-cell
peak, and the crop that the refine stage sees. Rust and Python are compared in the tests.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.signal
import torch
from numpy.typing import NDArray

from . import geometry
from .bundle import Bundle

Array = NDArray[np.float64]


def resize(image: NDArray, size_px: int) -> NDArray[np.float32]:
    """`half_pixel_antialias`: `[n, n]` or `[n, n, c]` -> `size_px`, bilinear with antialias, float."""
    planes = image[..., None] if image.ndim == 2 else image
    tensor = torch.from_numpy(np.ascontiguousarray(np.moveaxis(planes, -1, 0)[None], dtype=np.float32))
    out = torch.nn.functional.interpolate(tensor, size=(size_px, size_px), mode="bilinear", antialias=True, align_corners=False)
    out = np.moveaxis(out[0].numpy(), 0, -1)
    return out[..., 0] if image.ndim == 2 else out


def bilinear(image: NDArray, x: NDArray, y: NDArray) -> NDArray:
    """Samples at pixel positions, zero outside."""
    h, w = image.shape[:2]
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - x0, y - y0
    total = 0.0
    for dy, dx in itertools.product((0, 1), (0, 1)):
        xi, yi = x0 + dx, y0 + dy
        weight = (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
        weight = weight * ((xi >= 0) & (xi < w) & (yi >= 0) & (yi < h))
        value = image[yi.clip(0, h - 1), xi.clip(0, w - 1)]
        total = total + (weight[..., None] if image.ndim == 3 else weight) * value
    return total


def frame_pyramid(frame: NDArray, mask: NDArray, size_px: int) -> tuple[NDArray, NDArray]:
    """Step A: frame (0..255) and mask at twice the stage's input resolution; gray in 0..1, unseen pixels 0."""
    gray = resize(frame.astype(np.float32) / 255.0 * mask, 2 * size_px)
    share = resize(mask.astype(np.float32), 2 * size_px)
    seen = (share >= 0.5).astype(np.float32)
    return np.where(share > 0, gray / np.maximum(share, 1e-6), 0.0) * seen, seen


def hypothesis(gray2: NDArray, seen2: NDArray, rotation_deg: float, scale: float) -> NDArray[np.float32]:
    """Step B: the frame as it would look if its true yaw were the assumed one plus `rotation_deg` and its true
    footprint the assumed one times `scale`: `[2, n, n]`, gray (0 where unseen) and mask."""
    n = gray2.shape[0] // 2
    theta = np.radians(rotation_deg)
    c, s = np.cos(theta), np.sin(theta)
    offsets = np.array([-0.25, 0.25])
    middle = (n - 1) / 2
    gray, seen = np.zeros((n, n)), np.zeros((n, n))
    for oy, ox in itertools.product(offsets, offsets):
        x = np.arange(n)[None, :] - middle + ox
        y = np.arange(n)[:, None] - middle + oy
        # Image axes, y down: a clockwise turn by theta takes (x, y) to (c x - s y, s x + c y); this is its inverse.
        u, v = (c * x + s * y) / scale, (-s * x + c * y) / scale
        px, py = 2 * u + (2 * n - 1) / 2, 2 * v + (2 * n - 1) / 2
        gray += bilinear(gray2, px, py)
        seen += bilinear(seen2, px, py)
    mask = (seen >= 2.0).astype(np.float32)
    return np.stack([np.where(seen > 0, gray / np.maximum(seen, 1e-6), 0.0) * mask, mask]).astype(np.float32)


@dataclass
class CoarseResult:
    """A similarity, in window px (without margin), and what speaks for it."""

    centre: Array
    rotation_deg: float
    scale: float
    evidence: dict[str, float]
    quad: Array  # edges, window px


def similarity_quad(centre: Array, rotation_deg: float, scale: float, width: float) -> Array:
    """Edges TL, TR, BL, BR of a square of `width`, turned clockwise."""
    theta = np.radians(rotation_deg)
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]) * scale
    half = (geometry.RIGHT_BOTTOM - 0.5) * width
    return half @ turn.T + centre


def correlate(map_features: NDArray, frame_features: NDArray) -> NDArray:
    """Logits `[K, 2H - 1.., ..]` for every shift that leaves at least half of the frame inside: `[K, H, W]`, where entry
    (i, j) is the frame's middle cell lying on map cell (i, j) less (h - h // 2 * 2) / 2: top-left = (i, j) - h // 2."""
    _, big_h, big_w = map_features.shape
    k, _, h, w = frame_features.shape
    shape = (scipy.fft.next_fast_len(big_h + h), scipy.fft.next_fast_len(big_w + w))
    fm = scipy.fft.rfft2(map_features, shape)
    out = np.empty((k, big_h, big_w), np.float32)
    for i in range(k):
        ff = scipy.fft.rfft2(frame_features[i], shape)
        surface = scipy.fft.irfft2((fm * ff.conj()).sum(0), shape)
        out[i] = np.roll(surface, (h // 2, w // 2), (0, 1))[:big_h, :big_w]
    return out


def run_coarse(
    bundle: Bundle,
    window_rgb: NDArray,
    frame: NDArray,
    mask: NDArray | None = None,
    disc: tuple[float, float, float] | None = None,
    map_features: NDArray | None = None,
    rotations_deg: list[float] | None = None,
) -> CoarseResult:
    """The correlation stage. `window_rgb`: window with its margin at 1 m/px; `disc`: x, y (window px), radius (m);
    None searches the disc of the bundle's D_C about the middle of the window."""
    manifest = bundle.manifest
    stage = manifest["coarse"]
    margin = manifest["window_margin_m"]
    mask = np.ones_like(frame) if mask is None else mask
    if map_features is None:
        image = resize(window_rgb.astype(np.float32) / 255.0, stage["map"]["size_px"])
        map_features = bundle.run("coarse_map", map=np.moveaxis(image, -1, 0)[None])["map_features"]
    gray2, seen2 = frame_pyramid(frame, mask, stage["frame"]["size_px"])
    rotations = stage["rotations_deg"] if rotations_deg is None else rotations_deg
    hypotheses = list(itertools.product(rotations, stage["scales"]))
    frames = np.stack([hypothesis(gray2, seen2, r, s) for r, s in hypotheses])
    features = bundle.run("coarse", frame=frames)["frame_features"]
    logits = correlate(map_features[0], features).astype(np.float64)
    # Cell of the frame's middle -> window px.
    stride = stage["stride"]
    h = features.shape[-1]
    m_per_px = stage["map"]["width_m"] / stage["map"]["size_px"]

    def window_px(cell: NDArray) -> NDArray:
        middle = cell - h // 2 + (h - 1) / 2
        px = stride * middle + (stride - 1) / 2
        return (px + 0.5) * m_per_px - 0.5 - margin

    if disc is None:
        w = manifest["window_width_m"]
        disc = ((w - 1) / 2, (w - 1) / 2, manifest["search_radius_m"])
    xs, ys = window_px(np.arange(logits.shape[2])), window_px(np.arange(logits.shape[1]))
    inside = (xs[None] - disc[0]) ** 2 + (ys[:, None] - disc[1]) ** 2 <= disc[2] ** 2
    masked = np.where(inside[None], logits, -np.inf)
    best = int(masked.argmax())
    k, i, j = np.unravel_index(best, masked.shape)
    top = masked[k, i, j]
    p = np.exp(masked - top)
    total = p.sum()
    # Sub-cell: soft-argmax over the cells round the peak.
    r = stage["subcell_radius"]
    i0, i1, j0, j1 = max(i - r, 0), min(i + r + 1, logits.shape[1]), max(j - r, 0), min(j + r + 1, logits.shape[2])
    local = np.exp(logits[k, i0:i1, j0:j1] - logits[k, i0:i1, j0:j1].max())
    local /= local.sum()
    cell_y = (local.sum(1) * np.arange(i0, i1)).sum()
    cell_x = (local.sum(0) * np.arange(j0, j1)).sum()
    # Rotation and scale: each hypothesis by its best cell near the peak.
    near = logits[:, max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].reshape(len(hypotheses), -1).max(1)
    weight = np.exp(near - near.max())
    weight /= weight.sum()
    angles = np.array([x[0] for x in hypotheses])
    turn = angles[k] + (weight * ((angles - angles[k] + 180) % 360 - 180)).sum()
    scale = float((weight * np.array([x[1] for x in hypotheses])).sum())
    # Evidence on the posterior over places (all hypotheses together): mass of the square about a place; the second peak
    # is the heaviest square more than 6 cells from the first; the near peak the heaviest maximum nearer than that.
    places = p.sum(0)
    square = scipy.signal.convolve2d(places, np.ones((2 * r + 1, 2 * r + 1)), mode="same")
    mass = square[i, j] / total
    away = np.hypot(np.arange(places.shape[0])[:, None] - i, np.arange(places.shape[1])[None] - j) > 6
    second = np.where(inside & away, square, 0.0).max() / square[i, j]
    touching = scipy.signal.convolve2d(places, np.ones((3, 3)), mode="same")
    maximum = (places > 0) & (places >= scipy.ndimage.maximum_filter(places, 3, mode="constant"))
    rows, columns = np.abs(np.arange(places.shape[0]) - i), np.abs(np.arange(places.shape[1]) - j)
    maximum &= np.maximum(rows[:, None], columns[None]) >= 3
    near_peak = np.where(inside & ~away & maximum, touching, 0.0).max() / touching[i, j]
    share = places / total
    entropy = -(share[share > 0] * np.log2(share[share > 0])).sum()
    centre = np.array([window_px(cell_x), window_px(cell_y)])
    quad = similarity_quad(centre, turn, scale, manifest["frame_width_m"])
    evidence = {
        "peak_mass": float(mass),
        "second_peak": float(second),
        "near_peak": float(near_peak),
        "entropy_bits": float(entropy),
        "peak_logit": float(top),
    }
    return CoarseResult(centre, float(turn), scale, evidence, quad)


def oriented_crop(window_rgb: NDArray, margin: float, coarse: CoarseResult, size_px: int, width_m: float) -> NDArray[np.float32]:
    """The map under the coarse similarity, about its centre: `[3, n, n]` in 0..1; n x n samples a pixel."""
    step = width_m / size_px
    count = max(1, round(step))
    theta = np.radians(coarse.rotation_deg)
    c, s = np.cos(theta) * coarse.scale, np.sin(theta) * coarse.scale
    grid = (np.arange(size_px * count) - (size_px * count - 1) / 2) * (step / count)
    x, y = np.meshgrid(grid, grid)
    px = c * x - s * y + coarse.centre[0] + margin
    py = s * x + c * y + coarse.centre[1] + margin
    fine = bilinear(window_rgb.astype(np.float32) / 255.0, px, py)
    return np.moveaxis(fine.reshape(size_px, count, size_px, count, 3).mean((1, 3)), -1, 0).astype(np.float32)


def run_refine(
    bundle: Bundle, window_rgb: NDArray, frame: NDArray, mask: NDArray | None, coarse: CoarseResult
) -> tuple[Array, dict[str, float]]:
    """The refine stage with an oriented crop -> edges of the frame in window px `[4, 2]`, evidence."""
    manifest, stage = bundle.manifest, bundle.manifest["refine"]
    mask = np.ones_like(frame) if mask is None else mask
    width = manifest["frame_width_m"] + 2 * stage["crop"]["padding_m"]
    n = stage["map"]["size_px"]
    crop = oriented_crop(window_rgb, manifest["window_margin_m"], coarse, n, width)
    features = bundle.run("refine_map", map=crop[None])["map_features"]
    size = stage["frame"]["size_px"]
    share = resize(mask.astype(np.float32), size)
    seen = (share >= 0.5).astype(np.float32)
    gray = np.where(share > 0, resize(frame.astype(np.float32) / 255.0 * mask, size) / np.maximum(share, 1e-6), 0.0) * seen
    out = bundle.run("refine", map_features=features, frame=np.stack([gray, seen])[None])
    inclusive = geometry.displaced(n, out["displacement"][0])
    step = width / n
    # Inclusive corners -> edges in metres about the crop's middle, then the coarse similarity.
    metres = (inclusive + geometry.RIGHT_BOTTOM) * step - width / 2
    theta = np.radians(coarse.rotation_deg)
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]) * coarse.scale
    quad = metres @ turn.T + coarse.centre
    evidence = {"refine_residual_m": float(out["residual"][0] * step), "refine_weight": float(out["weight"][0])}
    return quad, evidence
