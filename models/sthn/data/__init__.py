"""Pairs to train and to evaluate on: one typed interface, several sources.

`pair.py` is the interface; `boson.py` the published HDF5 layout; `georeferenced.py` maps with or without a recorded
flight; `noise.py` the geometric noise of Table III; `spec.py` opens a source from a table of a TOML file.

    python -m sthn.data to-flight --folder DIR --split test --out FLIGHT
    python -m sthn.data pairs --folder DIR --split test --search-radius-m 512 --out pairs.json
"""

from .errors import DataError
from .noise import Noisy
from .pair import FRAME_PX, Noise, NoiseKind, Pair, PairSource
from .spec import open_source

__all__ = ["FRAME_PX", "DataError", "Noise", "NoiseKind", "Noisy", "Pair", "PairSource", "open_source"]
