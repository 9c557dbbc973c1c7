"""The two sides take turns, and ours does what the environment does."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.bench.sides import Ours, alternate


def test_sides_take_turns_and_medians_count() -> None:
    order: list[str] = []
    times = iter([1.0, 2.0, 50.0, 1.0, 2.0, 3.0])

    def ours() -> float:
        order.append("o")
        return next(times)

    def theirs() -> float:
        order.append("t")
        return 7.0

    assert alternate(ours, theirs, rounds=2, ours_per_round=3, theirs_per_round=1) == (2.0, 7.0)
    assert "".join(order) == "ooot" * 2


def test_our_side_steps_as_the_environment_does(gl: str) -> None:
    ours = Ours(images=True)
    assert [image.shape for image in ours.look()] == [(256, 256, 3)] * 2
    ours.step(np.zeros(7))
    assert ours.progress.steps == 1
    ours.reset(3)
    assert ours.progress.steps == 0
