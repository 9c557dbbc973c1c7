"""Put the states of a model file's scene into a task's: joints by name, whatever their order, fixtures by theirs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.hdf5.model_file import ModelFile, Pose, joints_of
from lerobot_memobench.datasets.hdf5.reading import Unusable
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.sim.simulation import Simulation

States = NDArray[np.float64]

BASE = "robot0_base"
BASE_TOLERANCE = 1e-3
"""How far the arm's base may be from ours, m: pictures, actions and proprioception are of one place."""
NEAR_TABLE = 0.1
"""How far above or below the table's top a fixture's origin may be, m; LIBERO's are up to 30 mm above it."""


def place(sim: Simulation, scene: ModelFile, states: States) -> tuple[States, dict[str, Pose]]:
    """Return states (T, D) of a model file's scene as states of a simulation's, and the poses of its fixtures.

    Raises:
        Unusable: the scene lacks a joint or a body, has one beyond the task, or is another one.
    """
    _check_joints(sim, scene)
    if states.shape[1] != scene.state_dim:
        raise Unusable(f"states have width {states.shape[1]}, expected {scene.state_dim} of the joints of model_file")
    scene.body_of(BASE)
    _check_base(sim, scene)
    placed = np.zeros((len(states), sim.state_dim))
    placed[:, 0] = states[:, 0]
    for name, ours in joints_of(sim.model).items():
        theirs = scene.joints[name]
        placed[:, ours.position], placed[:, ours.velocity] = states[:, theirs.position], states[:, theirs.velocity]
    return placed, {name: _fixture_pose(scene, name) for name in sim.fixture_poses()}


def _check_joints(sim: Simulation, scene: ModelFile) -> None:
    """Raise unless both scenes have the same joints, in whatever order."""
    ours = joints_of(sim.model)
    for name, joint in ours.items():
        found = scene.joints.get(name)
        if found is None:
            raise Unusable(f"model_file has no joint {name!r}, which task {sim.task.name} has")
        if found.kind != joint.kind:
            raise Unusable(f"model_file's joint {name!r} is of type {found.kind!r}, expected {joint.kind!r}")
    beyond = next((name for name in scene.joints if name not in ours), None)
    if beyond is not None:
        body = scene.joints[beyond].body
        raise Unusable(
            f"model_file moves the body {body!r} by the joint {beyond!r}, which task {sim.task.name} does not have"
        )


def _check_base(sim: Simulation, scene: ModelFile) -> None:
    theirs, ours = (np.array(model.body(BASE).pos) for model in (scene.model, sim.model))
    if np.abs(ours - theirs).max() > BASE_TOLERANCE:
        raise Unusable(
            f"model_file has the arm's base {BASE!r} at {theirs.round(3).tolist()}, expected {ours.round(3).tolist()}: "
            "it is of another scene than the benchmark's"
        )


def _fixture_pose(scene: ModelFile, name: str) -> Pose:
    pose = scene.rest_pose(name)
    if abs(pose[2] - TABLE_TOP) > NEAR_TABLE:
        raise Unusable(
            f"model_file has {name!r} at {pose[:3].round(3).tolist()}, not on the table at {TABLE_TOP} m: it is the "
            "scene before its fixtures were set up; store the scene of the simulation"
        )
    return pose
