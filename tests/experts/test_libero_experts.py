"""The expert solves the published tasks in the paper's world, which has other handles, grasps and floors."""

from __future__ import annotations

import pytest

from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.experts.test_expert import play
from tests.support.libero import needs_assets, simulate

SHORT = "check_the_top_drawer_of_the_cabinet"
SEED = 20_000
FLUSH = 2e-3
"""Distance of a thing's underside from the table, m."""
UPRIGHT = 0.999
"""Cosine of a thing's tilt."""


@needs_assets
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == SHORT else pytest.mark.slow) for name in task_names()]
)
def test_solves_every_task_in_order_and_smoothly(name: str) -> None:
    assert not play(get_task(name).in_world("libero"), SEED).faults


@needs_assets
@pytest.mark.parametrize(
    "name",
    [
        "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate",
        "turn_on_the_stove_and_turn_it_off_near_the_shelf",
    ],
)
def test_objects_are_upright_on_the_table(name: str) -> None:
    """Milk and ketchup have their y axis up; asset frames have z up."""
    sim = simulate(name)
    sim.reset(SEED)
    for thing in sim.task.objects:
        position, rotation = sim.asset_pose(thing)
        assert rotation[2, 2] > UPRIGHT
        assert abs(position[2] + sim.assets[thing].bottom - TABLE_TOP) < FLUSH
