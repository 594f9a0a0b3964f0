"""Pairs to train and to evaluate on: one typed interface, several sources."""

from .pair import Noise, Pair, PairSource

__all__ = ["Noise", "Pair", "PairSource"]
