"""The two sides take turns, and ours acts as the environment does."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

from research.speed import apart_case
from research.speed.sides import Apart, Ours, Times, Vectored, alternate, timed
from research.speed.threads import by_the_libraries, by_the_rule


def test_sides_take_turns_and_medians_count() -> None:
    order: list[str] = []
    times = iter([1.0, 2.0, 50.0, 1.0, 4.0, 5.0])

    def ours() -> Times:
        order.append("o")
        return Times(next(times), 3.0)

    def theirs() -> Times:
        order.append("t")
        return Times(7.0, 8.0)

    pairs = alternate(ours, theirs, rounds=2, ours_per_round=3, theirs_per_round=1)
    assert pairs == [((2.0, 3.0), (7.0, 8.0)), ((4.0, 3.0), (7.0, 8.0))]
    assert "".join(order) == "ooot" * 2


def test_waiting_is_no_work() -> None:
    taken = timed(lambda: time.sleep(0.2))
    assert taken.wall >= 0.2
    assert taken.cpu < taken.wall


def test_the_vector_environment_is_lerobots() -> None:
    side = Vectored()
    [inner] = side.env.envs
    side.step(np.zeros(7))
    assert inner.unwrapped.episode.progress.steps == 1
    side.reset(1)
    assert inner.unwrapped.episode.progress.steps == 0
    side.close()


def test_our_side_steps_as_the_environment_does() -> None:
    ours = Ours(images=True)
    assert [image.shape for image in ours.look()] == [(256, 256, 3)] * 2
    ours.step(np.zeros(7))
    assert ours.progress.steps == 1
    ours.reset(3)
    assert ours.progress.steps == 0


@pytest.mark.slow
def test_a_side_apart_has_the_threads_that_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """And keeps the opened object from one turn to the next."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2})
    here = dict(os.environ)
    for environment, expected in ((by_the_rule(), ["1", "1"]), (by_the_libraries(), [None, "3"])):
        side = Apart(apart_case.opened, environment)
        try:
            assert side.does(apart_case.remember, 1) == [1]
            side.ask(apart_case.remember, 2)
            assert side.answer() == [1, 2]
            torch, renderer, chosen = side.does(apart_case.threads)
            assert renderer == expected[1]
            assert expected[0] in (None, torch)
            assert bool(chosen) is (expected[0] is not None)  # a user's own values stay
            with pytest.raises(ValueError, match="no"):
                side.does(apart_case.fail)
        finally:
            side.close()
    assert dict(os.environ) == here
