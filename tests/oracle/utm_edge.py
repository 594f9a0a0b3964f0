"""A map at the edge of a UTM zone at latitude 60, and where a drone 512 m north-east of its middle is.

Usage: utm_edge.py OUT_DIR. Writes `edge.tif` and `edge.tsv`: lines of centre lat, lon, east_m, north_m, target lat, lon, and the
target's map pixel (integer = centre).
"""

import sys
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from rasterio.transform import Affine

out = Path(sys.argv[1])
to_utm = pyproj.Transformer.from_crs(4326, 32633, always_xy=True)
lon, lat = 17.99, 60.0
x, y = to_utm.transform(lon, lat)
transform = Affine(1, 0, np.floor(x) - 900, 0, -1, np.floor(y) + 900)
profile = {"driver": "GTiff", "count": 3, "width": 1800, "height": 1800, "dtype": "uint8", "crs": "EPSG:32633"}
# A pixel's colour says where it is.
rows, columns = np.mgrid[0:1800, 0:1800]
image = np.stack([columns // 8, rows // 8, (columns + rows) // 16]).astype(np.uint8)
with rasterio.open(out / "edge.tif", "w", transform=transform, tiled=True, compress="deflate", **profile) as d:
    d.write(image)
lines = []
for east, north in [(512, 0), (0, 512), (-512, 0), (0, -512), (362, 362), (-362, 362), (512, -512)]:
    lon2, lat2, _ = pyproj.Geod(ellps="WGS84").fwd(lon, lat, np.degrees(np.arctan2(east, north)), np.hypot(east, north))
    column, row = ~transform * to_utm.transform(lon2, lat2)
    lines.append("\t".join(map(repr, map(float, (lat, lon, east, north, lat2, lon2, column - 0.5, row - 0.5)))))
(out / "edge.tsv").write_text("\n".join(lines) + "\n")
