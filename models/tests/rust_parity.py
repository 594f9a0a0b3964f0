"""`python models/tests/rust_parity.py DIR`: the Python side of `tests/parity.rs`.

Makes, in DIR, a bundle of the published architecture (weights by formula), a map as GeoTIFF, a window cut from it and a
frame, and prints as JSON what the Python pipeline gives for them: corners, homography, position. The window is cut by
rasterio's numbers and pyproj, pixel by pixel: nothing of it is shared with the Rust code.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import rasterio
from numpy.typing import NDArray
from PIL import Image
from pyproj import Transformer
from rasterio.transform import from_origin

from sthn import export, pipeline, procedural
from sthn.bundle import read_bundle

MAP_PX = 1700
EPSG = 32640
"""UTM zone 40: at the place below its grid is turned by 0.7 degrees against north."""
ORIGIN = (322_400.0, 2_789_300.0)
CENTRE_PX = (848.3, 851.6)


def write_map(path: Path) -> None:
    """A procedural map at 1 m/px."""
    bands = procedural.image(MAP_PX).transpose(2, 0, 1)
    profile = {"driver": "GTiff", "width": MAP_PX, "height": MAP_PX, "count": 3, "dtype": "uint8", "crs": f"EPSG:{EPSG}"}
    tiles = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate", "photometric": "rgb"}
    with rasterio.open(path, "w", transform=from_origin(*ORIGIN, 1.0, 1.0), **profile, **tiles) as file:
        file.write(bands)


def cut_window(path: Path, centre: tuple[float, float], side: int) -> NDArray[np.uint8]:
    """The metric window about a position: every pixel along its own geodesic, through the map's projection, bilinear."""
    with rasterio.open(path) as file:
        pixels = file.read().transpose(1, 2, 0).astype(np.float64)
        to_crs = Transformer.from_crs("EPSG:4326", file.crs, always_xy=True)
        to_px = ~file.transform
    east, south = np.meshgrid(*[np.arange(side) - (side - 1) / 2] * 2)
    azimuth, distance = np.degrees(np.arctan2(east, -south)), np.hypot(east, south)
    lon, lat, _ = pipeline.WGS84.fwd(np.full_like(east, centre[1]), np.full_like(east, centre[0]), azimuth, distance)
    x, y = to_crs.transform(lon, lat)
    column, row = to_px @ (x, y)
    column, row = column - 0.5, row - 0.5  # rasterio counts from a pixel's edge
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    fx, fy = (column - left)[..., None], (row - top)[..., None]
    upper = pixels[top, left] * (1 - fx) + pixels[top, left + 1] * fx
    lower = pixels[top + 1, left] * (1 - fx) + pixels[top + 1, left + 1] * fx
    return np.floor(upper * (1 - fy) + lower * fy + 0.5).astype(np.uint8)


def main(folder: Path) -> None:
    """Writes the files and prints the numbers."""
    name = "published-1536"
    # The command tells its differences on stdout, which is for the numbers alone here.
    stdout, sys.stdout = sys.stdout, sys.stderr
    code = export.main(["--random-weights", "0", "--out", str(folder / name), "--name", name])
    sys.stdout = stdout
    if code:
        raise SystemExit(code)
    bundle = read_bundle(folder / name)
    write_map(folder / "map.tif")
    to_wgs84 = Transformer.from_crs(f"EPSG:{EPSG}", "EPSG:4326", always_xy=True)
    lon, lat = to_wgs84.transform(ORIGIN[0] + CENTRE_PX[0] + 0.5, ORIGIN[1] - CENTRE_PX[1] - 0.5)
    centre = (float(lat), float(lon))
    window = cut_window(folder / "map.tif", centre, int(bundle.manifest["window_width_m"]))
    frame = procedural.frame_of(window)
    Image.fromarray(window).save(folder / "window.png")
    Image.fromarray(frame).save(folder / "frame.png")
    match, (lat, lon) = pipeline.locate_pair(bundle, window, frame, centre)
    x, y = Transformer.from_crs("EPSG:4326", f"EPSG:{EPSG}", always_xy=True).transform(lon, lat)
    library = sorted((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so*"))[-1]
    numbers = {
        "onnxruntime": str(library),
        "bundle": name,
        "m_per_px": bundle.manifest["coarse"]["map"]["width_m"] / bundle.manifest["coarse"]["map"]["size_px"],
        "centre": centre,
        "coarse": match.coarse.tolist(),
        "quad": match.quad.tolist(),
        "final": match.final.tolist(),
        "homography": match.homography.tolist(),
        "position": [lat, lon],
        "map_crs": [x, y],
    }
    json.dump(numbers, sys.stdout)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
