"""Which pictures look the same? To the eye: what moved by a pixel or two, or is a shade darker, is no difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Simulation

Picture = NDArray[np.uint8]
"""(height, width, 3)."""

CAMERAS = ("agentview", "wrist")

SHIFT = 2
"""Pixels by which what is seen may have moved and still count as the same."""
COLOUR = 24
"""Largest difference of a colour channel, of 255, that still counts as the same."""


def photograph(sim: Simulation) -> tuple[Picture, ...]:
    """Return what the cameras see now."""
    return tuple(sim.render(camera) for camera in CAMERAS)


def unmatched(a: Picture, b: Picture, shift: int = SHIFT, colour: int = COLOUR) -> float:
    """Return the share of pixels of either picture without a like pixel near the same place in the other, in [0, 1].

    Args:
        a, b: (height, width, 3).
        shift: how far away a like pixel may be, pixels.
        colour: how far its channels may differ.
    """
    first, second = a.astype(np.int16), b.astype(np.int16)
    rows, columns = np.nonzero(np.abs(first - second).max(axis=-1) > colour)
    if not len(rows):
        return 0.0
    worst = 0
    for here, there in ((first, second), (second, first)):
        padded = np.pad(there, ((shift, shift), (shift, shift), (0, 0)), mode="edge")
        found = np.zeros(len(rows), dtype=bool)
        for dy in range(2 * shift + 1):
            for dx in range(2 * shift + 1):
                near = padded[rows + dy, columns + dx] - here[rows, columns]
                found |= np.abs(near).max(axis=-1) <= colour
        worst = max(worst, int((~found).sum()))
    return worst / first.shape[0] / first.shape[1]


def difference(a: Sequence[Picture], b: Sequence[Picture]) -> float:
    """Return how much two moments differ to the eye: the larger `unmatched` of the cameras."""
    return max(unmatched(x, y) for x, y in zip(a, b, strict=True))


def largest_pixel_difference(a: Sequence[Picture], b: Sequence[Picture]) -> int:
    """Return the largest difference of any channel of any pixel of the cameras, 0 to 255."""
    return max(int(np.abs(x.astype(np.int16) - y).max()) for x, y in zip(a, b, strict=True))


def differences(moments: Sequence[Sequence[Picture]]) -> NDArray[np.float64]:
    """Return `difference` of all pairs, (n, n)."""
    return pairwise_table(moments, difference)


def pairwise_table[Item](items: Sequence[Item], measure: Callable[[Item, Item], float]) -> NDArray[np.float64]:
    """Return a symmetric measure of all pairs, (n, n), with zeros on the diagonal."""
    table = np.zeros((len(items), len(items)))
    for i, j in combinations(range(len(items)), 2):
        table[i, j] = table[j, i] = measure(items[i], items[j])
    return table
