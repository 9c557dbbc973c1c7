"""The noise that plans are sampled from: each episode has its own, so that rows of a batch are independent."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor


class EpisodeNoise:
    """A seed per row of a vector environment, from its episode's first observation and the process's seed.

    Noise drawn from a common generator would make a row's actions depend on how many rows run beside it.
    """

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def reset(self) -> None:
        """Forget all episodes."""
        self.seeds = []

    def resize(self, rows: int) -> None:
        """Begin anew if the number of rows is another."""
        if len(self.seeds) != rows:
            self.seeds = [0] * rows

    def begin(self, row: int, observed: Iterable[Tensor]) -> None:
        """Begin a row's episode with its first observation."""
        digest = hashlib.blake2b(str(torch.initial_seed()).encode(), digest_size=7)
        for value in observed:
            digest.update(value.detach().to("cpu").contiguous().numpy().tobytes())
        self.seeds[row] = int.from_bytes(digest.digest(), "big")

    def draw(self, rows: Sequence[int], steps: Sequence[int], shape: tuple[int, int]) -> Tensor:
        """Return noise (n, *shape) on the CPU for plans of ``rows`` at ``steps``, those of all rows."""
        generators = (torch.Generator().manual_seed(self.seeds[row] + steps[row]) for row in rows)
        return torch.stack([torch.randn(shape, generator=generator) for generator in generators])
