"""Windows of the real maps by rasterio, pyproj and NumPy.

Usage: real_maps.py OUT_DIR MAPS_DIR. The layout of map_cases.py.
"""

import sys
from pathlib import Path

from map_cases import Cases

cases, maps = Cases(sys.argv[1]), Path(sys.argv[2])
for name, m_per_px in [
    ("demo/dubai_t1.tif", 1.0),
    ("demo/dubai_t3.tif", 1.0),
    ("train/dubai_t7.tif", 1.0),
    ("train/naip_berkeley.tif", 1.0),
    ("train/naip_north_dakota_5m_20200831.tif", 5.0),
]:
    stem = Path(name).stem
    cases.add(stem, maps / name, size=300, m_per_px=m_per_px)
    cases.lines[-1] = cases.lines[-1].replace(Path(name).name, name)
cases.close()
