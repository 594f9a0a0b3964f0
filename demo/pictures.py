"""The demo's two pictures: the track over the map, and one frame laid on the map by its published homography."""

from pathlib import Path

import cv2
import matplotlib
import numpy as np
import rasterio
from pyproj import Transformer

from flight import Flight, Row
from score import FRAME_M, WGS84, error_m

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402  (the backend is chosen first)

TRUTH, FIX = "#ffffff", "#ff9f1c"
MAP_PX = 1600


def track(flight: Flight, answers: list[dict], found: dict, path: Path) -> None:
    """Truth, fixes with their 95 % circles, and the map under them."""
    with rasterio.open(flight.map_path) as source:
        step = max(1.0, max(source.width, source.height) / MAP_PX)
        shape = (3, round(source.height / step), round(source.width / step))
        image = np.moveaxis(source.read((1, 2, 3), out_shape=shape), 0, -1)
        bounds, crs = source.bounds, source.crs
    to_map = Transformer.from_crs(4326, crs, always_xy=True)

    figure, axes = plt.subplots(figsize=(9, 9), dpi=110)
    axes.imshow(image, extent=(bounds.left, bounds.right, bounds.bottom, bounds.top))
    truths = [row.truth for row in flight.rows if row.truth]
    true_xy = to_map.transform([lon for _, lon in truths], [lat for lat, _ in truths])
    axes.plot(*true_xy, "+", color=TRUTH, ms=7, mew=1.2, label="truth")
    axes.plot([], [], ".-", color=FIX, ms=5, lw=0.8, label="fix, with its 95 % circle")
    for row, answer in zip(flight.rows, answers, strict=True):
        if answer["status"] != "fix":
            if row.truth:
                lat_deg, lon_deg = row.truth
                axes.plot(*to_map.transform(lon_deg, lat_deg), "x", color="#ff3b30", ms=7, mew=1.5)
            continue
        lon_deg, lat_deg = answer["lon_deg"], answer["lat_deg"]
        axes.plot(*to_map.transform(lon_deg, lat_deg), ".", color=FIX, ms=5)
        azimuths_deg = np.linspace(0.0, 360.0, 49)
        ones = np.ones_like(azimuths_deg)
        ring = WGS84.fwd(lon_deg * ones, lat_deg * ones, azimuths_deg, answer["radius95_m"] * ones)
        axes.plot(*to_map.transform(ring[0], ring[1]), "-", color=FIX, lw=0.8)
        if row.truth:
            x, y = to_map.transform([lon_deg, row.truth[1]], [lat_deg, row.truth[0]])
            axes.plot(x, y, "-", color="#ff3b30", lw=0.8)
    if found["fixes"] < found["frames"]:
        axes.plot([], [], "x", color="#ff3b30", ms=7, mew=1.5, label="no fix (at the truth)")
    median_m = found["error_m"]["median"]
    title = f"{found['fixes']} fixes in {found['frames']} frames"
    axes.set_title(title + (f", median error {median_m:.1f} m" if median_m is not None else ""))
    axes.set_xlabel(f"easting, m ({crs})")
    axes.set_ylabel("northing, m")
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.legend(loc="upper right", framealpha=0.8)
    figure.savefig(path, bbox_inches="tight", pil_kwargs={"quality": 88})
    plt.close(figure)


def typical(flight: Flight, answers: list[dict]) -> tuple[Row, dict] | None:
    """The row and answer with the median error; any fix where no truth is known; None without a fix."""
    pairs = [(row, answer) for row, answer in zip(flight.rows, answers, strict=True) if answer["status"] == "fix"]
    pairs.sort(key=lambda pair: error_m(pair[1], pair[0]) or 0.0)
    return pairs[len(pairs) // 2] if pairs else None


def window_image(map_path: Path, answer: dict) -> np.ndarray:
    """The searched window, RGB at 1 m/px, cut out of the map by the published affine."""
    with rasterio.open(map_path) as source:
        inverse = ~source.transform
        image = np.ascontiguousarray(np.moveaxis(source.read((1, 2, 3)), 0, -1))
    a, b, c, d, e, f = answer["window"]["map_affine"]
    side = round(answer["window"]["width_m"])
    window_to_map = np.array([[a, b, c], [d, e, f], [0, 0, 1]])
    # rasterio's (0, 0) is the first pixel's corner, the window's its centre.
    map_to_source = np.array([[inverse.a, inverse.b, inverse.c - 0.5], [inverse.d, inverse.e, inverse.f - 0.5], [0.0, 0.0, 1.0]])
    window_to_source = map_to_source @ window_to_map
    return cv2.warpAffine(image, window_to_source[:2], (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def overlay(flight: Flight, row: Row, answer: dict, rectified: np.ndarray, path: Path) -> None:
    """Left the frame as the network sees it, middle the searched window, right the frame laid on it."""
    window = window_image(flight.map_path, answer)
    side = window.shape[0]
    homography = np.array(answer["homography"])
    warped = cv2.warpPerspective(rectified, homography, (side, side))
    inside = cv2.warpPerspective(np.ones_like(rectified), homography, (side, side)) > 0
    # A chessboard of frame and map: roads that go on across its edges are the proof.
    cells = np.add.outer(np.arange(side) // 64, np.arange(side) // 64) % 2 == 0
    laid = window.copy()
    laid[inside & cells] = warped[inside & cells][:, None]
    edge = FRAME_M - 0.5
    square = np.array([[[-0.5, -0.5], [edge, -0.5], [edge, edge], [-0.5, edge], [-0.5, -0.5]]])
    quad = cv2.perspectiveTransform(square, homography)[0]

    figure, axes = plt.subplots(1, 3, figsize=(15, 5.4), dpi=90)
    axes[0].imshow(rectified, cmap="gray", vmin=0, vmax=255)
    axes[0].set_title(f"thermal frame {row.path.name}, 512 m")
    axes[1].imshow(window)
    axes[1].plot(*quad.T, color=FIX, lw=1.5)
    axes[1].set_title(f"searched window, {answer['window']['width_m']:.0f} m")
    axes[2].imshow(laid)
    axes[2].plot(*quad.T, color=FIX, lw=1.0)
    low, high = quad.min(0) - 40, quad.max(0) + 40
    axes[2].set_xlim(low[0], high[0])
    axes[2].set_ylim(high[1], low[1])
    error = error_m(answer, row)
    axes[2].set_title("frame on map" + (f", error {error:.1f} m" if error is not None else ""))
    for panel in axes:
        panel.set_axis_off()
    figure.savefig(path, bbox_inches="tight", pil_kwargs={"quality": 88})
    plt.close(figure)
