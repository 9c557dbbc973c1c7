"""A seed gives the scene that stock LIBERO draws from it."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import task_names
from tests.support.libero import needs_assets, record, simulate, some_of_all
from tests.support.scripts import load_script

EQUAL = 1e-9
"""Of poses, m."""


def apart(sim: Simulation, seeds: range) -> float:
    """Return the largest difference of any pose or joint from LIBERO's, over seeds."""
    script, kept = load_script("libero_records"), record("scenes")
    worst = 0.0
    for seed in seeds:
        sim._placer.place(seed)
        k = script.SEEDS.index(seed)
        worst = max(worst, np.abs(sim.data.qpos[9:] - kept[f"{sim.task.name}:qpos"][k, 9:] * script.GRAIN).max())
        poses = np.array(list(sim.fixture_poses().values())).reshape(-1, 7)
        wanted = kept[f"{sim.task.name}:fixtures"][k] * script.GRAIN
        worst = max(worst, np.abs(poses - wanted).max(initial=0.0))
    return worst


@needs_assets
@pytest.mark.parametrize("name", some_of_all(task_names()))
def test_scenes_of_evaluation_seeds(name: str) -> None:
    assert apart(simulate(name), range(7, 57)) <= EQUAL


@needs_assets
def test_a_reset_repeats_to_the_bit() -> None:
    sim = simulate("open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate")
    sim.reset(7)
    first = sim.state()
    sim.reset(8)
    assert not np.array_equal(first, sim.state())
    sim.reset(7)
    assert np.array_equal(first, sim.state())
