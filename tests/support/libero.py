"""Records of stock LIBERO, and simulations, for tests of scenes."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom

RECORDS = Path(__file__).parents[1] / "sim/libero"


@cache
def record(kind: str) -> dict[str, NDArray[Any]]:
    """Return what `scripts/libero_records.py` has recorded of a kind."""
    with np.load(RECORDS / f"{kind}.npz", allow_pickle=False) as stored:
        return dict(stored)


def recorded_answers(sim: Simulation, kept: dict[str, NDArray[Any]], name: str) -> tuple[list[Atom], list[list[bool]]]:
    """Return a task's recorded atoms, and their values in the simulator in each recorded state."""
    atoms = [Atom(word, tuple(names)) for word, *names in (str(one).split() for one in kept[f"{name}:atoms"])]
    fixtures = dict(zip(sim.fixture_poses(), kept[f"{name}:fixtures"], strict=True))
    state, found = np.zeros(sim.state_dim), []
    for qpos in kept[f"{name}:qpos"]:
        state[1 : 1 + sim.model.nq] = qpos / 1e6
        sim.set_state(state, fixtures)
        found.append([sim.holds(atom) for atom in atoms])
    return atoms, found


KINDS_OF_SCENES = (
    "check_the_middle_drawer_of_the_cabinet",
    "turn_on_the_stove_and_turn_it_off_near_the_shelf",
    "open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate",
    "put_the_tomato_into_the_top_drawer_and_the_biscuit_into_the_middle_drawer",
    "put_the_butter_picked_up_in_the_prompt_video_on_the_plate",
    "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt",
)
"""Tasks that together have every fixture, box and way of placing."""


def some_of_all(names: list[str]) -> list[Any]:
    """Return tasks as parameters of a test; all but one of each kind of scene are slow."""
    return [name if name in KINDS_OF_SCENES else pytest.param(name, marks=pytest.mark.slow) for name in names]


def simulate(name: str) -> Simulation:
    """Return a simulation of a task."""
    return Simulation(get_task(name))
