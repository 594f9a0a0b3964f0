"""The paper's rivals behind one interface (`base.Rival`): each is a row of the same table, on the same pairs."""

from .base import MIN_MATCHES, NO_WEIGHTS, Match, Rival, RivalError, Unready
from .registry import available, names

__all__ = ["MIN_MATCHES", "NO_WEIGHTS", "Match", "Rival", "RivalError", "Unready", "available", "names"]
