"""The 16-to-8-bit tone mapping, version 1: the same rule as `thermal::tone` in Rust, to the bit.

Integers only. With the n samples in ascending order, x[0] .. x[n - 1]:

1. k = n // 200, lo = x[k], hi = x[n - 1 - k]: 0.5 % at either end, so that a few hot or dead pixels do not set the scale;
2. where hi - lo < 64 the range is widened to 64 counts about its middle: lo = (lo + hi - 64) // 2, hi = lo + 64;
3. v -> (510 (v - lo) + (hi - lo)) // (2 (hi - lo)), held within 0..255: linear, rounded half up.
"""

import numpy as np

VERSION = 1
"""The version implemented here; a bundle states the one it was trained with."""

_CUT_ONE_IN = 200
_MIN_RANGE = 64


def tone_map(frame: np.ndarray) -> np.ndarray:
    """Maps a frame (uint8 or uint16, any shape) to uint8; uint8 passes unchanged. Other types are an error."""
    if frame.dtype == np.uint8:
        return frame
    if frame.dtype != np.uint16:
        raise TypeError(f"frame: expected uint8 or uint16, found {frame.dtype}")
    if frame.size == 0:
        return frame.astype(np.uint8)
    lo, hi = cut_points(frame)
    values = np.arange(1 << 16, dtype=np.int64)
    table = np.clip((510 * (values - lo) + (hi - lo)) // (2 * (hi - lo)), 0, 255).astype(np.uint8)
    return table[frame]


def cut_points(frame: np.ndarray) -> tuple[int, int]:
    """The counts that become 0 and 255 (the lower one may be negative)."""
    up_to = np.cumsum(np.bincount(frame.ravel(), minlength=1 << 16))
    k = frame.size // _CUT_ONE_IN
    # The first value with more than `rank` samples up to it is x[rank].
    lo, hi = (int(np.searchsorted(up_to, rank, side="right")) for rank in (k, frame.size - 1 - k))
    if hi - lo < _MIN_RANGE:
        lo = (lo + hi - _MIN_RANGE) // 2
        hi = lo + _MIN_RANGE
    return lo, hi
