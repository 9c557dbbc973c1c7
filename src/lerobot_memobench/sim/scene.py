"""Define a compiled scene, its camera and its time steps. Seeds change the state of a scene only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco

from lerobot_memobench.sim.asset import Asset
from lerobot_memobench.sim.libero.files import user_folders
from lerobot_memobench.tasks.task import Task
from mujoco_raster.drawlist import DrawList

AGENTVIEW = "agentview"

AGENTVIEW_POSITION = (0.6586131746834771, 0.0, 1.6103500240372423)
AGENTVIEW_QUATERNION = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
AGENTVIEW_ANGLE = 45.0
"""Vertical field of view of the agentview camera, degrees."""

ARENA_BYTES = 32 * 2**20
"""Memory for contacts and constraints of one simulation."""


@dataclass(frozen=True)
class Scene:
    """A compiled scene. The model is shared; modify copies only."""

    key: tuple[str, ...]
    model: mujoco.MjModel
    """The simulated model, without visual geoms."""
    assets: dict[str, Asset]
    """Instance name -> asset: objects, then fixtures without the table."""
    stand_ins: tuple[str, ...]
    """Published tasks: classes drawn by this package's objects because the paper's scans are not installed."""
    drawing: Callable[[], tuple[mujoco.MjModel, DrawList]]
    """Returns a visual model with equal bodies and joints, and its draw list."""


def scene_key(task: Task) -> tuple[str, ...]:
    """Return the cache key of a task's scene, which variants of a task share."""
    return task.name, task.suite, task.bddl_text, *user_folders()
