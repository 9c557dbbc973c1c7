"""The blind routine does the published task, and again when it is done."""

from __future__ import annotations

import pytest

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom

STOVE = "turn_on_the_stove_and_turn_it_off"
COUNTED = "turn_the_stove_on_and_off_a_given_number_of_times"
LIT = Atom("turnon", ("flat_stove_1",))


def test_published_task_is_done_and_begun_again() -> None:
    episode = Episode(get_task(STOVE))
    episode.reset(20_001)
    lit, turned_on, succeeded = False, 0, False
    for _ in range(600):
        episode.step(episode.blind_action())
        succeeded = succeeded or episode.success
        before, lit = lit, episode.sim.holds(LIT)
        turned_on += lit and not before
        if turned_on > 1:
            break
    assert succeeded
    assert turned_on > 1, "it goes on after the goal has come true"


@pytest.mark.slow
def test_blind_routine_fails_the_strict_task() -> None:
    episode = Episode(get_task(COUNTED))
    episode.reset(20_001)
    while not episode.done:
        episode.step(episode.blind_action())
    assert not episode.success
