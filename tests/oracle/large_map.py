"""A large DEFLATE map in an instant: every tile of it is the same compressed noise.

Usage: large_map.py OUT_DIR SIZE_PX TILE_PX M_PER_PX. Writes `large.tif`, classic TIFF, EPSG:32640.
"""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np

out, size, tile, m_per_px = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
packed = zlib.compress(np.random.default_rng(1).integers(0, 256, (tile, tile, 3), np.uint8).tobytes(), 1)
tiles = (-(-size // tile)) ** 2
SHORT, LONG, DOUBLE = ("H", 3), ("I", 4), ("d", 12)
keys = (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32640)
tags = [
    (256, LONG, (size,)),
    (257, LONG, (size,)),
    (258, SHORT, (8, 8, 8)),
    (259, SHORT, (8,)),
    (262, SHORT, (2,)),
    (277, SHORT, (3,)),
    (284, SHORT, (1,)),
    (322, LONG, (tile,)),
    (323, LONG, (tile,)),
    (324, LONG, (8,) * tiles),
    (325, LONG, (len(packed),) * tiles),
    (33550, DOUBLE, (m_per_px, m_per_px, 0.0)),
    (33922, DOUBLE, (0.0, 0.0, 0.0, 340000.0, 2800000.0, 0.0)),
    (34735, SHORT, keys),
]
start = 8 + len(packed) + len(packed) % 2
entries, far, at = b"", b"", start + 2 + 12 * len(tags) + 4
for tag, (code, kind), values in tags:
    data = struct.pack(f"<{len(values)}{code}", *values)
    if len(data) > 4:
        entries += struct.pack("<HHII", tag, kind, len(values), at + len(far))
        far += data
    else:
        entries += struct.pack("<HHI", tag, kind, len(values)) + data.ljust(4, b"\0")
body = b"II*\0" + struct.pack("<I", start) + packed.ljust(start - 8, b"\0") + struct.pack("<H", len(tags)) + entries
Path(out, "large.tif").write_bytes(body + b"\0\0\0\0" + far)
