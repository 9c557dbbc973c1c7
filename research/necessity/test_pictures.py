"""Pictures compared as an eye does."""

from __future__ import annotations

import numpy as np
import pytest

from research.necessity.demonstrations import Picture, differences, unmatched
from research.necessity.drawn import scene


def test_equal_pictures_have_nothing_unmatched() -> None:
    assert unmatched(scene(), scene()) == 0.0
    assert unmatched(scene(), scene(colour=(200, 40, 40))) == 0.0, "a shade is no difference"


@pytest.mark.parametrize("shift", [{"dy": 2}, {"dx": -2}, {"dy": 1, "dx": 2}])
def test_what_moved_by_two_pixels_looks_the_same(shift: dict[str, int]) -> None:
    assert unmatched(scene(), scene(**shift)) == 0.0


def test_what_moved_further_or_went_does_not() -> None:
    # Of a square moved by 6: 4 rows of red have no red near them, and of the wall now covered 4 rows of 6 no wall.
    assert unmatched(scene(), scene(dy=6)) * 64 * 64 == 4 * 10 + 4 * 6
    # Of one that is gone: all its red; the wall behind it counts in the other direction, where it is less.
    assert unmatched(scene(), scene(gone=True)) * 64 * 64 == 100
    assert unmatched(scene(gone=True), scene()) == unmatched(scene(), scene(gone=True))


def test_differences_are_of_the_camera_that_differs_most() -> None:
    table = differences([(scene(), scene()), (scene(), scene(gone=True)), (scene(gone=True), scene(dy=6))])
    assert table[0, 1] == pytest.approx(100 / 4096)
    assert table[0, 2] == pytest.approx(100 / 4096)
    assert np.array_equal(table, table.T)
    assert not table.diagonal().any()


def as_numpy_says(a: Picture, b: Picture, shift: int, colour: int) -> float:
    """`unmatched`, written without a thought of speed."""
    worst = 0
    for here, there in ((a.astype(int), b.astype(int)), (b.astype(int), a.astype(int))):
        padded = np.pad(there, ((shift, shift), (shift, shift), (0, 0)), mode="edge")
        height, width, _ = here.shape
        near = [
            np.abs(padded[dy : dy + height, dx : dx + width] - here).max(axis=-1) <= colour
            for dy in range(2 * shift + 1)
            for dx in range(2 * shift + 1)
        ]
        worst = max(worst, int((~np.any(near, axis=0)).sum()))
    return worst / a.shape[0] / a.shape[1]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("shift", "colour"), [(0, 24), (1, 60), (2, 24)])
def test_pictures_are_compared_pixel_by_pixel_as_numpy_would(seed: int, shift: int, colour: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (30, 20, 3), dtype=np.uint8)
    b = np.where(rng.random((30, 20, 1)) < 0.5, a, np.roll(a, 1, axis=seed % 2)).astype(np.uint8)
    b[:5, :5] = rng.integers(0, 256, (5, 5, 3))
    found = unmatched(a, b, shift, colour)
    assert found == as_numpy_says(a, b, shift, colour)
    assert found > 0
