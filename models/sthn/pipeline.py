"""The whole of a localisation in numpy and ONNX Runtime: decoded pixels in, latitude and longitude out.

The reference that `src/locate/` is tested against, in the paper's order, in double precision outside the graphs. Window
pixels are those of the W_S square at 1 m/px; `map_rgb` may be wider by the bundle's margin on each side.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import Geod

from . import geometry
from .bundle import Bundle, BundleError
from .network.resize import half_pixel_weights, published_weights, resize

WGS84 = Geod(ellps="WGS84")

Pixels = NDArray[np.uint8]
Floats = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class PairMatch:
    """What a pair gave. Quads are the frame's edges in window px: TL, TR, BL, BR."""

    coarse: geometry.Quad
    """After the coarse stage."""
    quad: geometry.Quad
    """After the last stage."""
    homography: Floats
    """Rectified-frame px -> window px, `[3, 3]`. Paper Eq. (7)."""
    final: Floats
    """`quad` as displacement of the coarse map input's inclusive corners, `[2, 2, 2]`."""
    inputs: dict[str, dict[str, NDArray[np.float32]]]
    """What each graph was fed, by graph and port."""


def match_pair(bundle: Bundle, map_rgb: Pixels, frame: Pixels, seen: NDArray[np.bool_] | None = None) -> PairMatch:
    """Matches a rectified frame with a window: coarse, crop, refine, DLT.

    `map_rgb`: `[W, W, 3]`, W = window and margin; `frame`: `[F, F]` gray; `seen`: where the sensor saw the ground.
    """
    manifest = bundle.manifest
    side, frame_px = _sides(manifest)
    if map_rgb.shape != (side, side, 3) or frame.shape != (frame_px, frame_px):
        raise BundleError(f"pair: expected {side} px of map and {frame_px} px of frame, found {map_rgb.shape}, {frame.shape}")
    inputs: dict[str, dict[str, NDArray[np.float32]]] = {}
    # Coarse: D_RS->RT = F_H(I_RS, I_RT). Eq. (1), (2)
    if manifest["coarse"]["kind"] != "matcher":
        raise BundleError(f"coarse.kind: expected matcher, found {manifest['coarse']['kind']}")
    coarse = run_coarse_matcher(bundle, map_rgb, frame, seen, inputs)
    quad = coarse
    # Refine: the box B round the warped corners, at full resolution; D_S->T = D_S->B + D_B->T. Eq. (4), (7)
    if "refine" in manifest:
        shape = manifest["refine"]["crop"]["shape"]
        if shape != "bounding_box":
            raise BundleError(f"refine.crop.shape: expected bounding_box, found {shape}")
        quad = run_refine_bounding_box(bundle, map_rgb, frame, seen, coarse, inputs)
    return PairMatch(coarse, quad, geometry.homography_of_edges(frame_px, quad), final_displacement(manifest, quad), inputs)


def _sides(manifest: dict[str, Any]) -> tuple[int, int]:
    return int(manifest["window_width_m"] + 2 * manifest["window_margin_m"]), int(manifest["frame_width_m"])


def weights(rule: str, size_in: int, size_out: int) -> Floats:
    """1-D weights of a resize rule that takes a whole image."""
    if rule == "half_pixel_antialias":
        return half_pixel_weights(size_in, size_out)
    if rule == "align_corners_antialias":
        return published_weights(size_in, size_out)
    raise BundleError(f"resize: expected half_pixel_antialias or align_corners_antialias, found {rule}")


def map_input(map_rgb: Pixels, spec: dict[str, Any], inset_px: int = 0) -> NDArray[np.float32]:
    """`[W, W, 3]` without `inset_px` on each side -> `[1, 3, R, R]` in 0..1."""
    side = map_rgb.shape[0]
    inner = map_rgb[inset_px : side - inset_px, inset_px : side - inset_px].transpose(2, 0, 1) / 255.0
    return resize(inner, weights(spec["resize"], inner.shape[1], spec["size_px"]))[None].astype(np.float32)


def frame_input(frame: Pixels, seen: NDArray[np.bool_] | None, spec: dict[str, Any]) -> NDArray[np.float32]:
    """`[F, F]` -> `[1, C, R, R]` in 0..1, by the manifest's content.

    `gray_mask`: gray is weighted by the mask, so that what was not seen does not darken its neighbours, and a pixel counts
    as seen where at least half of its weight was.
    """
    along = weights(spec["resize"], frame.shape[0], spec["size_px"])
    gray = frame[None] / 255.0
    if spec["content"] == "gray_mask":
        mask = np.ones_like(gray) if seen is None else seen[None].astype(np.float64)
        share = resize(mask, along)
        visible = share >= 0.5
        weighted = np.divide(resize(gray * mask, along), share, out=np.zeros_like(share), where=visible)
        return np.concatenate([weighted, visible])[None].astype(np.float32)
    channels = {"gray": 1, "gray_thrice": 3}[spec["content"]]
    return np.repeat(resize(gray, along), channels, axis=0)[None].astype(np.float32)


def run_matcher(
    bundle: Bundle, stage: str, map_image: NDArray[np.float32], frame_image: NDArray[np.float32], inputs: dict[str, Any]
) -> geometry.Quad:
    """Both graphs of a matcher stage -> inclusive corners in its map input."""
    features = bundle.run(f"{stage}_map", map=map_image)["map_features"]
    displacement = bundle.run(stage, map_features=features, frame=frame_image)["displacement"]
    inputs[f"{stage}_map"] = {"map": map_image}
    inputs[stage] = {"map_features": features, "frame": frame_image}
    if not np.isfinite(displacement).all():
        raise BundleError(f"{stage}: displacement: expected finite numbers, found {displacement.tolist()}")
    return geometry.displaced(map_image.shape[-1], displacement[0])


def run_coarse_matcher(
    bundle: Bundle, map_rgb: Pixels, frame: Pixels, seen: NDArray[np.bool_] | None, inputs: dict[str, Any]
) -> geometry.Quad:
    """The published kind of coarse stage -> the frame's edges in window px. D' = alpha D, below Eq. (3)."""
    stage = bundle.manifest["coarse"]
    image = map_input(map_rgb, stage["map"], int(bundle.manifest["window_margin_m"]))
    corners = run_matcher(bundle, "coarse", image, frame_input(frame, seen, stage["frame"]), inputs)
    return geometry.edges_of_inclusive(corners, _m_per_px(stage["map"]))


def run_refine_bounding_box(
    bundle: Bundle, map_rgb: Pixels, frame: Pixels, seen: NDArray[np.bool_] | None, coarse: geometry.Quad, inputs: dict[str, Any]
) -> geometry.Quad:
    """The published kind of refine stage -> the frame's edges in window px."""
    stage = bundle.manifest["refine"]
    start, width = bounding_box(coarse, stage["crop"]["padding_m"])
    image = crop_bounding_box(map_rgb, start + bundle.manifest["window_margin_m"], width, stage["map"]["size_px"])
    corners = run_matcher(bundle, "refine", image, frame_input(frame, seen, stage["frame"]), inputs)
    return combine(corners, start, width, stage["map"]["size_px"])


def _m_per_px(spec: dict[str, Any]) -> float:
    return spec["width_m"] / spec["size_px"]


def bounding_box(coarse: geometry.Quad, padding_m: float) -> tuple[Floats, float]:
    """The square box B round a quad of edges: x and y of its first sample (window px) and its width W_B, padded."""
    low, high = coarse.min(0) + 0.5, coarse.max(0) + 0.5
    width = float((high - low).max()) + 2 * padding_m
    return (low + high) / 2 - width / 2, width


def crop_bounding_box(map_rgb: Pixels, start: Floats, width: float, size_out: int) -> NDArray[np.float32]:
    """`[1, 3, n, n]` in 0..1: sample i at the pixel centre start + i (W_B - 1) / (n - 1), bilinear, zero outside."""
    steps = np.arange(size_out) / (size_out - 1) * (width - 1)
    rows, columns = _hat(start[1] + steps, map_rgb.shape[0]), _hat(start[0] + steps, map_rgb.shape[1])
    return np.einsum("yh,hwc,xw->cyx", rows, map_rgb / 255.0, columns, optimize=True)[None].astype(np.float32)


def _hat(at: Floats, size: int) -> Floats:
    """`[n, size]`: weights of linear interpolation at `at`, zero outside."""
    return np.clip(1 - np.abs(np.arange(size) - at[:, None]), 0, None)


def combine(corners: geometry.Quad, start: Floats, width: float, size_px: int) -> geometry.Quad:
    """D_S->T = D_S->B + eta D_RB->RT as edges in window px; eta = W_B / W_R. Eq. (7)"""
    return geometry.edges_of_inclusive(corners, width / size_px) + start


def final_displacement(manifest: dict[str, Any], quad: geometry.Quad) -> Floats:
    """A quad of edges as displacement of the coarse map input's inclusive corners."""
    spec = manifest["coarse"]["map"]
    margin_px = 0.0 if manifest["coarse"]["kind"] == "matcher" else manifest["window_margin_m"]
    return geometry.displacement_of(spec["size_px"], geometry.inclusive_of_edges(quad, _m_per_px(spec), margin_px))


def window_to_lat_lon(
    point_px: Floats, centre: tuple[float, float], window_px: int, m_per_px: float = 1.0
) -> tuple[float, float]:
    """A window pixel -> latitude and longitude, degrees: its ENU offset from the window's middle, along the geodesic.

    `centre`: latitude and longitude of pixel ((n - 1) / 2, (n - 1) / 2).
    """
    east, south = (np.asarray(point_px, dtype=np.float64) - (window_px - 1) / 2) * m_per_px
    lon, lat, _ = WGS84.fwd(centre[1], centre[0], np.degrees(np.arctan2(east, -south)), np.hypot(east, south))
    return float(lat), float(lon)


def locate_pair(
    bundle: Bundle, map_rgb: Pixels, frame: Pixels, centre: tuple[float, float]
) -> tuple[PairMatch, tuple[float, float]]:
    """A pair -> the match and the position of a nadir vehicle, over the frame's middle. Eq. (8)"""
    match = match_pair(bundle, map_rgb, frame)
    middle = geometry.apply(match.homography, [(frame.shape[0] - 1) / 2] * 2)
    return match, window_to_lat_lon(middle, centre, int(bundle.manifest["window_width_m"]))
