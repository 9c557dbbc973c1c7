"""What simulator tests share: a scene of the arm alone, and tasks by name."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable

import mujoco
import pytest

from lerobot_memobench.sim import robot
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
BOWLS = "put_the_butter_into_the_bowl_from_the_prompt_video"


@pytest.fixture(scope="session")
def arm_model() -> mujoco.MjModel:
    """The arm alone."""
    spec = mujoco.MjSpec.from_string(robot.robot_xml())
    robot.hide_helpers(spec)
    return spec.compile()


@pytest.fixture
def simulate() -> Callable[..., Simulation]:
    """Return a function of a task's name that gives a simulation, reset to seed 7."""

    def make(name: str = DRAWER, seed: int = 7) -> Simulation:
        sim = Simulation(get_task(name))
        sim.reset(seed)
        return sim

    return make


@pytest.fixture
def mujoco_renderer(gl: str, monkeypatch: pytest.MonkeyPatch) -> type[mujoco.Renderer]:
    """MuJoCo's own renderer on the backend in use; by itself it takes the one of MUJOCO_GL at MuJoCo's import."""
    backend = importlib.import_module(f"mujoco.{gl}")
    contexts = sys.modules[mujoco.Renderer.__module__].gl_context
    monkeypatch.setattr(contexts, "GLContext", backend.GLContext)
    return mujoco.Renderer
