"""Which pictures look the same? To the eye: what moved by a pixel or two, or is a shade darker, is no difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
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
    if np.array_equal(a, b):
        return 0.0
    first, second = a.astype(np.int16), b.astype(np.int16)
    worst = max(_lacking(first, second, shift, colour), _lacking(second, first, shift, colour))
    return float(worst / first.shape[0] / first.shape[1])


@njit
def _lacking(here: NDArray[np.int16], there: NDArray[np.int16], shift: int, colour: int) -> int:
    """Return how many pixels of one picture have no like pixel near the same place in the other."""
    height, width, _ = here.shape
    lacking = 0
    for y in range(height):
        for x in range(width):
            if not _like(here, y, x, there, y, x, colour):  # most are like the one at the very place
                lacking += not _near(here, y, x, there, shift, colour)
    return lacking


@njit
def _near(here: NDArray[np.int16], y: int, x: int, there: NDArray[np.int16], shift: int, colour: int) -> bool:
    for v in range(max(y - shift, 0), min(y + shift + 1, there.shape[0])):
        for u in range(max(x - shift, 0), min(x + shift + 1, there.shape[1])):
            if _like(here, y, x, there, v, u, colour):
                return True
    return False


@njit
def _like(here: NDArray[np.int16], y: int, x: int, there: NDArray[np.int16], v: int, u: int, colour: int) -> bool:
    like = True
    for channel in range(3):
        like &= abs(here[y, x, channel] - there[v, u, channel]) <= colour
    return like


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
