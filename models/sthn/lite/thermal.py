"""Thermal pictures made from colour: strong domain randomisation, for training only.

Nobody's physics: the aim is that no rule from colour to temperature can be learnt, only structure. Materials get
random temperatures, contrast inverts, sensors lose resolution. The renderer of `nightfix simulate` is another one.
"""

from __future__ import annotations

import cv2
import numpy as np


def smooth_field(size: int, cells: int, rng: np.random.Generator) -> np.ndarray:
    """A smooth random field, about unit variance."""
    return cv2.resize(rng.standard_normal((cells, cells)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)


def unit(image: np.ndarray) -> np.ndarray:
    """Zero mean, unit variance (constant pictures become zero)."""
    return (image - image.mean()) / max(float(image.std()), 1e-3)


def brightest(rgb: np.ndarray) -> np.ndarray:
    """Largest of the three channels (numpy's reduction over a short last axis is ten times slower)."""
    return np.maximum(np.maximum(rgb[..., 0], rgb[..., 1]), rgb[..., 2])


def mean_channel(rgb: np.ndarray) -> np.ndarray:
    """Mean of the three channels."""
    return (rgb[..., 0] + rgb[..., 1] + rgb[..., 2]) / 3


def materials(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pixels softly assigned to a few colours of the scene, each with its own temperature."""
    n = rgb.shape[0]
    count = int(rng.integers(4, 13))
    flat = rgb.reshape(-1, 3)
    centres = flat[rng.integers(0, len(flat), count)] + rng.normal(0, 0.02, (count, 3)).astype(np.float32)
    width = np.exp(rng.uniform(np.log(0.02), np.log(0.12)))
    # Squared distance less |pixel|^2, which is the same for all centres. Centres first: reductions run along memory.
    distance = (centres**2).sum(1)[:, None] - 2 * centres @ flat.T
    weight = np.exp((distance.min(0) - distance) * np.float32(1 / (2 * width**2)))
    temperature = rng.standard_normal(count).astype(np.float32)
    return unit(((temperature @ weight) / weight.sum(0)).reshape(n, n))


def tone_curve(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random mix of the colours through a random smooth curve, inverted or not monotone half of the time."""
    mix = rng.normal(0.33, 0.35, 3).astype(np.float32)
    value = cv2.transform(rgb, mix[None])
    saturation = brightest(rgb) - np.minimum(np.minimum(rgb[..., 0], rgb[..., 1]), rgb[..., 2])
    value = value + rng.normal(0, 0.6) * saturation
    low, high = np.percentile(value[::4, ::4], [1, 99])
    position = np.clip((value - low) / max(high - low, 1e-3), 0, 1)
    if rng.random() < 0.5:
        knots = np.sort(rng.random(6))
    else:
        knots = rng.random(6)
    if rng.random() < 0.5:
        knots = knots[::-1]
    curve = cv2.resize(knots[None].astype(np.float32), (256, 1), interpolation=cv2.INTER_CUBIC)[0]
    return unit(curve[(position * 255).astype(np.uint8)])


def render(rgb8: np.ndarray, classes: np.ndarray | None, m_per_px: float, rng: np.random.Generator) -> np.ndarray:
    """uint8 RGB `[n, n, 3]` (and classes `[n, n]`) -> thermal values f32 `[n, n]`, about unit variance."""
    rgb = rgb8.astype(np.float32) / 255.0
    if rng.random() < 0.3:
        rgb = cv2.blur(rgb, (3, 3))
    picture = materials(rgb, rng) if rng.random() < 0.6 else tone_curve(rgb, rng)
    if rng.random() < 0.2:
        other = materials(rgb, rng) if rng.random() < 0.5 else tone_curve(rgb, rng)
        picture = unit(picture + rng.uniform(0.3, 1.0) * other)
    gray = mean_channel(rgb)
    if rng.random() < 0.7:
        detail = gray - cv2.GaussianBlur(gray, (0, 0), rng.uniform(1.5, 6.0))
        picture = picture + rng.normal(0, 0.7) * unit(detail)
    if classes is not None and rng.random() < 0.5:
        offsets = rng.standard_normal(256).astype(np.float32)
        picture = unit(picture) + rng.uniform(0.3, 1.5) * cv2.blur(offsets[classes], (3, 3))
    picture = change(unit(picture), m_per_px, rng)
    return unit(picture)


def change(picture: np.ndarray, m_per_px: float, rng: np.random.Generator) -> np.ndarray:
    """What is on the map but not there any more, and the other way round: blurred patches, boxes, hot spots."""
    n = picture.shape[0]
    picture = picture.astype(np.float32).copy()
    if rng.random() < 0.5:
        soft = cv2.GaussianBlur(picture, (0, 0), 12 / m_per_px)
        for _ in range(int(rng.integers(1, 12))):
            h, w = (rng.uniform(10, 70, 2) / m_per_px).astype(int) + 1
            y, x = rng.integers(0, n, 2)
            picture[y : y + h, x : x + w] = soft[y : y + h, x : x + w]
    if rng.random() < 0.6:
        for _ in range(int(rng.integers(1, 25))):
            h, w = rng.uniform(3, 30, 2) / m_per_px
            box = cv2.boxPoints(((rng.uniform(0, n), rng.uniform(0, n)), (max(w, 1.0), max(h, 1.0)), rng.uniform(0, 180)))
            cv2.fillPoly(picture, [box.astype(np.int32)], float(rng.normal(0, 1.8)))
    if rng.random() < 0.3:  # a lake, a field or smoke that the map does not have
        blob = smooth_field(n, int(rng.integers(3, 7)), rng) > rng.uniform(0.9, 1.8)
        picture[blob] = picture[blob] * rng.uniform(0, 0.6) + rng.normal(0, 1.2)
    return picture


def sensor(picture: np.ndarray, m_per_px: float, rng: np.random.Generator) -> np.ndarray:
    """Unit-variance values -> what an 8-bit frame holds, f32 in 0..1: blur, noise, gain, stripes, stretch."""
    n = picture.shape[0]
    if rng.random() < 0.6:
        picture = picture + rng.uniform(0.1, 0.9) * smooth_field(n, int(rng.integers(2, 6)), rng)
    if rng.random() < 0.4:
        picture = picture * np.exp(rng.uniform(0.1, 0.4) * smooth_field(n, int(rng.integers(2, 5)), rng))
    if rng.random() < 0.7:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.5, 5.0) / m_per_px)
    loss = rng.uniform(1.0, 4.0) / m_per_px
    if loss > 1.2 and rng.random() < 0.5:
        small = max(int(n / loss), 16)
        picture = cv2.resize(cv2.resize(picture, (small, small), interpolation=cv2.INTER_AREA), (n, n))
    if rng.random() < 0.3:  # motion
        length = int(rng.integers(2, max(3, int(8 / m_per_px) + 1)))
        kernel = np.zeros((length, length), np.float32)
        cv2.line(kernel, (0, int(rng.integers(0, length))), (length - 1, int(rng.integers(0, length))), 1.0)
        picture = cv2.filter2D(picture, -1, kernel / max(kernel.sum(), 1.0))
    if rng.random() < 0.4:
        picture = picture + rng.uniform(0.02, 0.25) * rng.standard_normal((1, n)).astype(np.float32)
    noise = np.exp(rng.uniform(np.log(0.01), np.log(0.35)))
    picture = picture + noise * rng.standard_normal((n, n)).astype(np.float32)
    if rng.random() < 0.3:
        y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j].astype(np.float32)
        picture = picture + rng.normal(0, 0.5) * (x * x + y * y)
    low, high = np.percentile(picture[::3, ::3], [rng.uniform(0, 3), rng.uniform(97, 100)])
    picture = np.clip((picture - low) / max(high - low, 1e-3), 0, 1)
    if rng.random() < 0.5:
        picture = picture ** np.exp(rng.uniform(-0.5, 0.5))
    if rng.random() < 0.3:
        picture = rng.uniform(0, 0.4) + picture * rng.uniform(0.3, 0.6)
    return np.round(picture * 255) / 255


def colour_jitter(rgb8: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The map as another provider, season or sensor would show it: f32 `[n, n, 3]` in 0..1."""
    rgb = rgb8.astype(np.float32) / 255.0
    if rng.random() < 0.8:
        mix = np.eye(3, dtype=np.float32) + rng.normal(0, 0.12, (3, 3)).astype(np.float32)
        rgb = cv2.transform(rgb, mix)
        rgb = (rgb - 0.5) * rng.uniform(0.6, 1.5) + 0.5 + rng.uniform(-0.15, 0.15)
        rgb = np.clip(rgb, 0, 1) ** np.exp(rng.uniform(-0.4, 0.4))
    if rng.random() < 0.15:
        rgb = np.repeat(mean_channel(rgb)[..., None], 3, axis=2)
    if rng.random() < 0.3:
        rgb = cv2.GaussianBlur(rgb, (0, 0), rng.uniform(0.4, 1.2))
    if rng.random() < 0.3:
        rgb = rgb + rng.normal(0, 0.03) * smooth_field(rgb.shape[0], 4, rng)[..., None]
    return np.clip(rgb, 0, 1)
