"""Two checkouts take turns, and a folder that is none is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from research.speed.checkouts import PARTS, Side, compare
from research.speed.sides import TASK


class Stub(Side):
    """A side that takes a while, without a process."""

    def __init__(self, times: list[float]) -> None:
        self._times = iter([0.0, *times])

    def take(self, steps: int) -> list[float]:
        return [0.0] * (len(PARTS) - 1) + [next(self._times)]


def test_ratios_are_those_of_pairs() -> None:
    found = compare(Stub([1.0, 2.0, 4.0]), Stub([2.0, 6.0, 4.0]), rounds=3, steps=1)
    assert found["ratio"] == 2.0
    assert found["ours"]["all"] == 2.0
    assert found["theirs"]["all"] == 4.0


def test_a_folder_that_is_no_checkout(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="is no checkout of this project"):
        Side(tmp_path, TASK, "default")
