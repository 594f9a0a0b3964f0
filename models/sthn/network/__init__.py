"""The published STHN network (Xiao et al., RA-L 2024), written anew from the paper and from measured behaviour.

Read `two_stage.py` first: the algorithm in the paper's order. `matcher.py` is one stage.
"""

from .config import ConfigError, NetworkConfig
from .correlation import Lookup
from .matcher import Matcher
from .resize import half_pixel_weights, published_weights, resize, resize_satellite, resize_thermal
from .two_stage import FINE_LEVELS, Box, Match, Sthn, bounding_box, combine, crop

__all__ = [
    "FINE_LEVELS",
    "Box",
    "ConfigError",
    "Lookup",
    "Match",
    "Matcher",
    "NetworkConfig",
    "Sthn",
    "bounding_box",
    "combine",
    "crop",
    "half_pixel_weights",
    "published_weights",
    "resize",
    "resize_satellite",
    "resize_thermal",
]
