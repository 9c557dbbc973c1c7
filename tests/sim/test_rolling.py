"""In strict scenes what rolls comes to rest; published scenes are as they were."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task

PUBLISHED = "put_the_artichoke_into_the_top_drawer_and_the_chestnut_into_the_middle_drawer"
STRICT = "find_the_artichoke_or_the_chestnut_hidden_in_two_of_the_drawers"
SPEED = 0.15


def rolled(task: str, name: str) -> tuple[float, float]:
    """Lay a thing on its side, give it a push, and return how far it is after a second, m, and its speed then, m/s."""
    sim = Simulation(get_task(task))
    sim.reset(20_000)
    joint = sim.data.joint(f"{name}_joint0")
    lying = Rotation.from_euler("y", 90, degrees=True).as_quat(scalar_first=True)
    joint.qpos[:] = [-0.1, 0.25, TABLE_TOP + sim.assets[name].radius + 0.001, *lying]
    joint.qvel[:] = 0.0
    for _ in range(4):
        sim.step(NO_OP)
    joint.qvel[1] = SPEED
    start = joint.qpos[:2].copy()
    for _ in range(20):
        sim.step(NO_OP)
    return float(np.linalg.norm(joint.qpos[:2] - start)), float(np.linalg.norm(joint.qvel[:3]))


def test_what_rolls_in_a_published_scene_stops_in_a_strict_one() -> None:
    far, fast = rolled(PUBLISHED, "artichoke_1")
    near, slow = rolled(STRICT, "artichoke_1")
    assert fast > 0.02, "in the published scene it still rolls"
    assert slow < 0.002
    assert near < 0.3 * far
