"""Which pair comes when: a function of the seed and the pair's number alone, so that a training goes on anywhere.

Passes over the real set, each in another order and with other draws. With a generated set passes alternate: one real, one
generated, the latter capped at as many pairs as the real set has (N_T), drawn anew each time.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ..data.pair import Pair, PairSource, TrainingSource

Batch = tuple[Tensor, Tensor, Tensor]
"""Window u8 `[B, W_S, W_S, 3]`, frame u8 `[B, F, F]`, truth f32 `[B, 2, 2, 2]`."""


class Stream(Dataset):
    """Pair number n of a training."""

    def __init__(self, real: TrainingSource, extended: TrainingSource | None, seed: int, side_px: int) -> None:
        self.sources = [real] if extended is None else [real, extended]
        self.counts = [len(real)] if extended is None else [len(real), min(len(extended), len(real))]
        self.seed, self.side_px = seed, side_px

    def place(self, number: int) -> tuple[int, int, int]:
        """Pass, which source, and index in it."""
        cycle, rest = divmod(number, sum(self.counts))
        which = 0 if rest < self.counts[0] else 1
        passed = cycle * len(self.counts) + which
        return passed, which, int(self._order(passed)[rest - (self.counts[0] if which else 0)])

    @functools.lru_cache(maxsize=2)  # noqa: B019 - one stream a process
    def _order(self, passed: int) -> np.ndarray:
        which = passed % len(self.counts)
        return np.random.default_rng([self.seed, passed, 1]).permutation(len(self.sources[which]))[: self.counts[which]]

    def pair(self, number: int) -> Pair:
        """The pair with this number."""
        passed, which, index = self.place(number)
        return self.sources[which].reseeded((self.seed, passed))[index]

    def __getitem__(self, number: int) -> Batch:
        return tensors(self.pair(number), self.side_px)


class Fixed(Dataset):
    """A source as it is, for validation."""

    def __init__(self, source: PairSource, side_px: int) -> None:
        self.source, self.side_px = source, side_px

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Batch:
        return tensors(self.source[index], self.side_px)


def tensors(pair: Pair, side_px: int) -> Batch:
    """A pair as the loop takes it; bytes, for the device to convert."""
    truth = torch.from_numpy(pair.displacement(side_px).astype(np.float32))
    return torch.from_numpy(np.array(pair.satellite)), torch.from_numpy(np.array(pair.thermal)), truth


class Steps:
    """Numbers of the pairs of each step from `start` on, this process's share of them."""

    def __init__(self, start: int, steps: int, batch: int, rank: int = 0, world: int = 1) -> None:
        if batch % world:
            raise ValueError(f"training.batch: expected a multiple of {world} processes, found {batch}")
        self.start, self.steps, self.batch, self.rank, self.share = start, steps, batch, rank, batch // world

    def __len__(self) -> int:
        return max(0, self.steps - self.start)

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.start, self.steps):
            first = step * self.batch + self.rank * self.share
            yield list(range(first, first + self.share))


def loader(stream: Dataset, batches: object, workers: int) -> DataLoader:
    """Batches in order, whatever the number of workers."""
    return DataLoader(stream, batch_sampler=batches, num_workers=workers, prefetch_factor=4 if workers else None)
