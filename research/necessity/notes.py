"""Motions by which a policy without a memory uses the scene as a notebook, or looks into a drawer.

The scripted adversaries of both commands make them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.grasping import pick, put_on_region
from lerobot_memobench.experts.hand import OPEN
from lerobot_memobench.experts.travel import release_fixture
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.task import Task

Motion = Iterator[NDArray[np.float32]]
GENTLE = 0.3
"""Largest linear action of a hand that pulls."""


def opened_to(expert: Expert, name: str, share: float) -> float:
    """Return a position of a drawer, door or knob between closed (0) and open or on (1), m or rad."""
    joint = expert.sim.world.articulation(name)[0]
    end = joint.on_at_least if joint.kind == "knob" else joint.open_below
    return joint.closed_q + share * (end - joint.closed_q)


def pull(expert: Expert, name: str, to: float) -> Motion:
    """Open a drawer, door or knob up to a position, m or rad, and hold it there; one that is further open stays.

    A hand that pulls as fast as it travels would shoot 2 cm past the position.
    """
    hand, world = expert.hand, expert.sim.world
    joint, travels = world.articulation(name)[0], expert.hand.speed
    way = np.sign(to - joint.closed_q)
    for action in expert.achieve(Atom("turnon" if joint.kind == "knob" else "open", (name,))):
        if way * (world.articulation(name)[1] - to) >= 0.0:
            break
        hand.speed = travels if hand.sim.gripper_command() <= OPEN else min(travels, GENTLE)
        yield action
    hand.speed = travels


def leave_ajar(expert: Expert, name: str, to: float) -> Motion:
    """Open a drawer, door or knob up to a position, m or rad, and let go of it."""
    yield from pull(expert, name, to)
    yield from release_fixture(expert.hand)


def shift(expert: Expert, name: str, by: float) -> Motion:
    """Carry an object sideways, m."""
    where = expert.sim.body_pose(name)[0] + np.array([0.0, by, 0.0])
    held = yield from pick(expert.hand, name, place=where)
    if held is not None:
        yield from put_on_region(expert.hand, held, where)


def loose_object(task: Task) -> str:
    """Return an object that the goal does not ask for; where there is none, any."""
    asked = {name for atom in atoms(task.goal) if atom.predicate in ("on", "in") for name in atom.args}
    return next((name for name in task.objects if name not in asked), next(iter(task.objects)))
