"""Points of every allow-listed system, transformed by pyproj.

Usage: crs_points.py OUT_DIR CODE... Writes `points.tsv`: EPSG code, lat, lon, x, y. The points lie in each system's area of use.
"""

import sys
from pathlib import Path

import numpy as np
import pyproj

lines = []
for code in map(int, sys.argv[2:]):
    crs = pyproj.CRS.from_epsg(code)
    west, south, east, north = crs.area_of_use.bounds
    east += 360 if east < west else 0
    forward = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
    for u, v in np.random.default_rng(code).uniform(0.02, 0.98, (12, 2)):
        lon, lat = west + u * (east - west), south + v * (north - south)
        lon = (lon + 180) % 360 - 180
        x, y = forward.transform(lon, lat)
        if np.isfinite(x) and np.isfinite(y):
            lines.append("\t".join(map(repr, (code, float(lat), float(lon), float(x), float(y)))))
Path(sys.argv[1], "points.tsv").write_text("\n".join(lines) + "\n")
