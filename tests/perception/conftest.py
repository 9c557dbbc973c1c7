"""What the tests of eyes share: a tower that is small, and a scene that is reset."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from lerobot_memobench.perception.tower import Tower
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task

BOWLS = "put_the_butter_into_the_bowl_from_the_prompt_video"
DRAWERS = "put_the_tomato_into_the_top_drawer_of_the_cabinet"


@pytest.fixture
def small_tower() -> Callable[[], Tower]:
    """Make a tower of a few thousand weights."""
    return lambda: Tower((4, 4, 8, 8, 16), (0, 0, 0, 1, 0))


@pytest.fixture
def simulate() -> Callable[[str], Simulation]:
    """Return a function of a task's name that gives a simulation, reset."""

    def make(name: str) -> Simulation:
        sim = Simulation(get_task(name))
        sim.reset(20_000)
        return sim

    return make
