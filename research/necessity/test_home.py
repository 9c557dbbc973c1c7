"""The arm is brought home and the world stays as it is."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from research.necessity.demonstrations import Home, difference, largest_pixel_difference, photograph
from research.necessity.scene import PIXEL_EXACT

PAN = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it"


def test_the_arm_comes_home_and_the_simulation_goes_on_as_if_it_had_not(gl: None) -> None:
    task = get_task(PAN)
    runs = []
    for look in (False, True):
        sim = Simulation(task)
        sim.reset(7)
        home = Home(sim)
        at_start = photograph(sim)
        for _ in range(6):
            sim.step(np.array([0.5, 0.5, 0.3, 0.0, 0.0, 0.2, 1.0]))
        if look:
            assert difference(photograph(sim), at_start) > 0.01, "the arm has moved"
            assert largest_pixel_difference(home.look(), at_start) <= PIXEL_EXACT
        for _ in range(3):
            sim.step(NO_OP)
        runs.append(sim.state())
    np.testing.assert_array_equal(*runs)
