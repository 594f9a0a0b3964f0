"""A split of the published layout as a recorded flight and a GeoTIFF, so that `nightfix replay` runs on it.

The published map has no coordinates. It gets invented ones: UTM at 1 m/px, where the projection's scale is 1.0000, so that
distances in pixels are metres on the ground to 3e-5. Its frames are aligned with the map's columns, i.e. with **grid**
north: their yaw, clockwise from true north, is the grid's convergence where they are.
"""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import rasterio
from pyproj import Geod, Transformer
from rasterio.transform import Affine
from rasterio.windows import Window
from tqdm import tqdm

from .boson import BosonPairs

EPSG = 32612
MIDDLE_EASTING_M, MIDDLE_NORTHING_M = 680_000.0, 3_900_000.0
"""180 km east of the central meridian the scale of UTM is 1.0000."""

FIRST_STAMP_NS = 1_600_000_000_000_000_000
STEP_NS = 1_000_000_000
STRIP_PX = 512

COLUMNS = (
    "file", "stamp_ns", "gsd_m", "yaw_deg", "prior_lat_deg", "prior_lon_deg", "prior_radius_m",
    "truth_lat_deg", "truth_lon_deg", "truth_yaw_deg",
)  # fmt: skip

WGS84 = Geod(ellps="WGS84")


class Georeference:
    """Rows and columns of the map -> WGS84, through the invented grid."""

    def __init__(self, height_px: int, width_px: int) -> None:
        west = round(MIDDLE_EASTING_M - width_px / 2)
        north = round(MIDDLE_NORTHING_M + height_px / 2)
        self.transform = Affine(1.0, 0.0, west, 0.0, -1.0, north)
        self._to_wgs84 = Transformer.from_crs(EPSG, 4326, always_xy=True)

    def lat_lon(self, row: float, column: float) -> tuple[float, float]:
        """Of the middle of a square that is n px wide and begins n / 2 before (row, column): the corner that four pixels
        share, at (row - 0.5, column - 0.5) where an integer is a pixel's centre."""
        x, y = self.transform @ (column, row)
        lon, lat = self._to_wgs84.transform(x, y)
        return lat, lon

    def north(self, row: float, column: float, step_px: float = 10.0) -> tuple[float, float]:
        """Azimuth of the map's "up", degrees clockwise from true north, and ground metres of a pixel."""
        lower, upper = self.lat_lon(row + step_px, column), self.lat_lon(row - step_px, column)
        azimuth, _, length = WGS84.inv(lower[1], lower[0], upper[1], upper[0])
        return azimuth, length / (2 * step_px)


def to_flight(pairs: BosonPairs, out: Path, limit: int | None = None) -> int:
    """Writes `out`: `map.tif`, `flight.toml`, `poses.csv`, `frames/`. Returns the number of frames."""
    out = Path(out)
    (out / "frames").mkdir(parents=True, exist_ok=True)
    place = Georeference(*pairs.satellite.size_px)
    write_map(pairs.satellite.pixels(), place, out / "map.tif")
    count = len(pairs) if limit is None else min(limit, len(pairs))
    with (out / "poses.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for index in tqdm(range(count), desc="frames", disable=None):
            query, centre = pairs.indices(index)
            name = f"frames/{index:06}.png"
            if not cv2.imwrite(str(out / name), pairs.queries.gray(query)):
                raise OSError(f"{out / name}: not written")
            row, column = pairs.queries.positions[query]
            truth, prior = place.lat_lon(row, column), place.lat_lon(*np.round(pairs.database.positions[centre]))
            yaw_deg, gsd_m = place.north(row, column)
            positions = [f"{value:.9f}" for value in (*prior, *truth)]
            table.writerow(
                [name, FIRST_STAMP_NS + index * STEP_NS, f"{gsd_m:.7f}", f"{yaw_deg:.6f}", *positions[:2]]
                + [f"{pairs.search_radius_m:g}", *positions[2:], f"{yaw_deg:.6f}"]
            )
    (out / "flight.toml").write_text(
        f'schema = 1\nname = "{pairs.name}, D_C = {pairs.search_radius_m:g} m"\nmap = "map.tif"\n'
        'notes = "Converted by sthn.data to-flight. The georeference is invented; only relative positions mean anything."\n',
        encoding="utf-8",
    )
    return count


def write_map(pixels: np.ndarray, place: Georeference, path: Path) -> None:
    """The map as tiled, deflated GeoTIFF; where all bands are 0 there is no map."""
    height, width, _ = pixels.shape
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 3, "dtype": "uint8", "nodata": 0}
    tiles = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate", "predictor": 2, "photometric": "RGB"}
    with rasterio.open(path, "w", crs=f"EPSG:{EPSG}", transform=place.transform, **profile, **tiles) as file:
        for top in tqdm(range(0, height, STRIP_PX), desc="map", disable=None):
            strip = pixels[top : top + STRIP_PX]
            file.write(np.moveaxis(strip, -1, 0), window=Window(0, top, width, len(strip)))
