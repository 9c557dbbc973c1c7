"""Simulate one task: reset, step, render, and evaluate atoms."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import reprlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.constants import ACTION_DIM
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.jobs.threads import at_once, has_second_core
from lerobot_memobench.sim import robot
from lerobot_memobench.sim.placement import Placer
from lerobot_memobench.sim.scene import AGENTVIEW, GLOW, GLOW_OFF, GLOW_ON, GLOW_SITES, Scene, get_scene
from lerobot_memobench.sim.world import HiddenObject, HiddenObjects, StartState, World
from lerobot_memobench.tasks.formula import SINCE_START, Atom
from lerobot_memobench.tasks.task import STRICT, Task
from mujoco_raster.drawlist import Image
from mujoco_raster.errors import RasterError
from mujoco_raster.highlights import Highlight

if TYPE_CHECKING:
    from mujoco_raster.rasterizer import Rasterizer

Array = NDArray[np.float64]

MJCF_CAMERAS = {"agentview": AGENTVIEW, "wrist": robot.WRIST_CAMERA}
STABILISATION_STEPS = 10  # objects start 1 to 8 cm above the table and fall in these steps
SETTLED_SHIFT, SETTLED_SPEED = 0.01, 0.02
"""Largest horizontal shift of an object while a scene settles, m, and largest speed after it, m/s or rad/s."""
MAX_SCENES = 200  # maximum number of draws of a strict scene
NO_OP = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])  # no motion, gripper open

DEFAULT, HIGH = "default", "high"
QUALITIES = (DEFAULT, HIGH)  # ``high`` is for figures and videos: a pixel is the mean of four samples
CACHED_RASTERIZERS = 4  # rasterizers cached per thread; each holds textures and backgrounds of its scene, some 40 MB


class InvalidActionError(MemobenchError):
    """Invalid action: not numeric, wrong shape, or not finite."""


class UnstablePhysicsError(MemobenchError):
    """MuJoCo reported a warning: it reset the scene, or exhausted its memory."""


def as_action[F: np.floating](action: ArrayLike, dtype: type[F]) -> NDArray[F]:
    """Return an action as a finite array (7,); raise `InvalidActionError` for another."""
    try:
        array: NDArray[F] = np.asarray(action, dtype=dtype)
    except (TypeError, ValueError):  # text, ragged lists, tensors of another device
        raise InvalidActionError(
            f"an action is {reprlib.repr(action)}; expected {ACTION_DIM} numbers, as an array ({ACTION_DIM},)"
        ) from None
    if array.shape != (ACTION_DIM,):
        raise InvalidActionError(f"an action has shape {array.shape}; expected ({ACTION_DIM},)")
    if not np.isfinite(array).all():
        raise InvalidActionError(
            f"an action contains a value that is not finite: {array.tolist()}; check the policy's output"
        )
    return array


@dataclass(frozen=True)
class RenderSettings:
    """Size and quality of frames; see `QUALITIES`."""

    height: int = 256
    width: int = 256
    quality: str = DEFAULT


class _RasterizerCache(threading.local):
    """Rasterizers of a thread, by scene and size; one serves one thread at a time."""

    def __init__(self) -> None:
        self.rasterizers: OrderedDict[tuple[object, ...], dict[str, Rasterizer]] = OrderedDict()


_cache = _RasterizerCache()


def get_rasterizers(scene: Scene, height: int, width: int) -> dict[str, Rasterizer]:
    """Return this thread's rasterizers of a scene, by the cameras' names, shared by simulations of the scene."""
    from mujoco_raster.rasterizer import Rasterizer  # loads numba

    key, cached = (scene, height, width), _cache.rasterizers
    if key not in cached:
        while len(cached) >= CACHED_RASTERIZERS:
            cached.popitem(last=False)
        first = Rasterizer(*scene.drawing(), width, height)
        second = first.copy() if has_second_core() else first
        cached[key] = dict(zip(MJCF_CAMERAS.values(), (first, second), strict=True))
    cached.move_to_end(key)
    return cached[key]


@dataclass(frozen=True)
class Snapshot:
    """Complete state of a simulation; see `Simulation.snapshot`."""

    physics: Array
    goal_position: Array
    goal_rotation: Array
    gripper: Array
    goes_on: bool  # whether the state continues its predecessor (`StartState.mark_step`)
    hidden: tuple[HiddenObject, ...] = ()  # objects outside the scene


class Simulation:
    """Simulate the scene of one task at 20 Hz; the task's goal is not used.

    After `reset` and each `step`, positions, contacts and velocity-dependent terms in `data` match the present state.
    All queries are functions of `state()` and the fixtures' poses.
    """

    def __init__(self, task: Task, render: RenderSettings | None = None) -> None:
        scene = get_scene(task)
        self.task = task
        self.render_settings = render or RenderSettings()
        self._scene = scene
        self._strict = task.suite == STRICT
        self.model: mujoco.MjModel = copy.copy(scene.model)
        # robosuite's force and torque sensors are unused, but cost time in each physics step.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR.value
        self.data = mujoco.MjData(self.model)
        self.assets = scene.assets
        self.stand_ins = scene.stand_ins
        self.world = World(task, self.model, self.data, scene.assets)
        self._start = StartState(self.model, self.data, tuple(task.objects), self.world.joints)
        self._hidden = HiddenObjects(self.model, self.data)
        self._at_home: Snapshot | None = None
        self.caught_at_home = False  # whether the detent at home caught the hand in the last step
        self.settled = True
        """Whether objects rested where they were placed after `reset`. Some of LIBERO's placements do not."""
        self._begun: Snapshot | None = None
        self.highlights: tuple[Highlight, ...] = ()
        self._drawn: tuple[mujoco.MjModel, mujoco.MjData] | None = None
        self._controller = robot.Controller(self.model)
        self._placer = Placer(task, self.model, self.data, scene.assets)
        self._hand = self.model.body(robot.HAND_BODY).id
        self._grip = self.model.site(robot.GRIP_SITE).id
        self._full = mujoco.mjtState.mjSTATE_INTEGRATION.value
        self._glowing = [name for name, asset in scene.assets.items() if asset.class_name in GLOW_SITES]

    # --- life -----------------------------------------------------------------------------------------------

    def reset(
        self,
        seed: int,
        settling: Callable[[Callable[[Atom], bool]], None] | None = None,
        state: Array | None = None,
    ) -> None:
        """Sample the initial state of a seed, or set a stored one, and run the stabilisation steps.

        Equal seeds of equal tasks give bit-equal states, independent of earlier simulation.

        Args:
            settling: called with `holds` after each stabilisation step.
            state: initial state (state_dim,), as of `catalogue.initial_states`. The seed then draws the poses of the
                fixtures only, which a state does not contain, as LIBERO's ``seed``, ``reset`` and ``set_init_state``.
        """
        self._at_home, self.caught_at_home = None, False
        self._hidden.absent = ()
        # A strict scene is drawn again while an object is thrown or still moves after the stabilisation.
        for draw in range(MAX_SCENES):
            self.settled = self._set_up(seed, draw, settling, state)
            if self.settled or not self._strict:
                break
        else:
            raise MemobenchError(
                f"task {self.task.name}: an object was thrown or moved in each of {MAX_SCENES} draws of the initial "
                f"state of seed {seed}; move the regions of its :init apart"
            )
        self._start.mark_hand()
        self._at_home = self.snapshot() if self._strict else None
        self.begin_execution()

    def _set_up(
        self, seed: int, draw: int, settling: Callable[[Callable[[Atom], bool]], None] | None, state: Array | None
    ) -> bool:
        """Return whether objects rest where they were placed, and nothing moves."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[robot.ARM] = robot.ARM_START
        self.data.qpos[robot.FINGERS] = robot.GRIPPER_OPEN if self._strict else robot.GRIPPER_START
        self._placer.place(seed, draw)
        self.highlights = ()
        mujoco.mj_step1(self.model, self.data)
        self._controller.reset(self.data)
        if self._strict:
            self._controller.gripper = -robot.CLOSING_SIGNS  # the command of open fingers
        if state is not None:
            self.set_state(state)
        drawn_positions = {name: self.data.body(name).xpos.copy() for name in self.task.objects}
        for step in range(STABILISATION_STEPS):
            if state is None:
                self.step(NO_OP)
            else:
                self._controller.settle(self.data, first=step == 0)
                self._check_physics(self.data.time)
            if settling is not None:
                settling(self.holds)
        # Horizontal shifts only, because the objects fall.
        shifts = [self.data.body(name).xpos[:2] - position[:2] for name, position in drawn_positions.items()]
        moved = max((float(np.linalg.norm(shift)) for shift in shifts), default=0.0)
        return moved <= SETTLED_SHIFT and float(np.abs(self.data.qvel[robot.OTHERS]).max(initial=0.0)) <= SETTLED_SPEED

    def begin_execution(self) -> None:
        """Store the present state as the reference of the atoms in `SINCE_START`."""
        self._start.mark_scene()
        self._begun = self.snapshot()

    def step(self, action: ArrayLike) -> None:
        """Advance by one control step of 50 ms.

        Args:
            action: (7,) pose delta (±1 is ±5 cm, ±0.5 rad) and gripper (−1 open, +1 closed); clipped to [−1, 1].

        Raises:
            InvalidActionError: the action is invalid; the state is unchanged.
            UnstablePhysicsError: MuJoCo reported a warning; call `reset` before further steps.
        """
        action = as_action(action, np.float64)
        time = self.data.time
        self._start.mark_step()
        self._controller.set_goal(self.data, action)
        self._controller.advance(self.data, float(action[6]))
        self._check_physics(time)
        if self._hidden.absent:
            ajar = [hidden.region for hidden in self._hidden.absent if self._start.left_dead_centre(hidden.region)]
            revealed = self._hidden.reveal(ajar)
            self._hidden.park()
            mujoco.mj_step1(self.model, self.data)
            self._start.mark_objects(revealed)
        closing = action[6] > 0.0  # closing the hand leaves the detent
        self.caught_at_home = False
        if self._at_home is not None and self._begun is not None and not closing and self._start.in_detent():
            self.caught_at_home = True
            if self._start.nearly_as_begun():
                self._put_back(self._begun)
            else:
                self._put_back(self._at_home, arm_only=True)

    def _check_physics(self, time: float) -> None:
        """Raise for MuJoCo's warnings; without the check it silently continues from the model's initial state."""
        counts = self.data.warning.number
        if counts.any():
            kind = int(counts.argmax())
            warning = mujoco.mju_warningText(kind, int(self.data.warning.lastinfo[kind])).split(".")[0]
            counts[:] = 0
            raise UnstablePhysicsError(f"the physics broke down {time:.2f} s after the scene was set up: {warning}")

    def _put_back(self, start: Snapshot, arm_only: bool = False) -> None:
        """Restore a snapshot to the bit, except for the time: the whole scene, or arm, fingers and controller only."""
        # Joint angles, not only the hand's pose: the arm is redundant, and its configuration would reveal its earlier
        # motion.
        time, qpos, qvel = self.data.time, self.data.qpos.copy(), self.data.qvel.copy()
        absent = self._hidden.absent
        self.restore(start)
        if arm_only:
            self._hidden.absent = absent
            rest = robot.OTHERS
            self.data.qpos[rest], self.data.qvel[rest] = qpos[rest], qvel[rest]
            mujoco.mj_step1(self.model, self.data)
        else:
            self._start.mark_objects(self.absent)
        self.data.time = time

    # --- state ----------------------------------------------------------------------------------------------

    @property
    def state_dim(self) -> int:
        """Length of `state()`."""
        return int(1 + self.model.nq + self.model.nv)

    @property
    def physics_dim(self) -> int:
        """Length of `Snapshot.physics`."""
        return mujoco.mj_stateSize(self.model, self._full)

    def state(self) -> Array:
        """Return time, qpos and qvel as one vector (state_dim,), as the published files store it."""
        return np.concatenate([[self.data.time], self.data.qpos, self.data.qvel])

    def set_state(self, state: Array, fixture_poses: dict[str, Array] | None = None) -> None:
        """Set a recorded state for queries and rendering; fixtures stay by default.

        The previously set state counts as its predecessor (`StartState.mark_step`).
        """
        state = np.asarray(state, dtype=np.float64)
        if state.shape != (self.state_dim,):
            raise MemobenchError(
                f"a state of task {self.task.name} has shape {state.shape}; expected ({self.state_dim},)"
            )
        self._start.mark_step()
        for name, pose in (fixture_poses or {}).items():
            body = self.model.body(name).id
            self.model.body_pos[body], self.model.body_quat[body] = pose[:3], pose[3:]
        self.data.time = state[0]
        self.data.qpos[:] = state[1 : 1 + self.model.nq]
        self.data.qvel[:] = state[1 + self.model.nq :]
        mujoco.mj_step1(self.model, self.data)
        self._check_physics(float(state[0]))

    def fixture_poses(self) -> dict[str, Array]:
        """Return position and quaternion wxyz (7,) of each fixture; they vary by seed and are not part of `state()`."""
        return {
            name: np.concatenate([self.model.body(name).pos, self.model.body(name).quat])
            for name, asset in self.assets.items()
            if asset.kind == "fixture"
        }

    def snapshot(self) -> Snapshot:
        """Return the complete state, including controller and solver warm start."""
        physics = np.empty(self.physics_dim)
        mujoco.mj_getState(self.model, self.data, physics, self._full)
        controller = self._controller
        goal = controller.goal_position.copy(), controller.goal_rotation.copy(), controller.gripper.copy()
        return Snapshot(physics, *goal, self._start.goes_on, self._hidden.absent)

    def restore(self, snapshot: Snapshot, *, replayed: bool = False) -> None:
        """Restore a snapshot of this simulation, bit for bit.

        ``replayed``: whether the present state precedes the snapshot, as in the original episode.
        """
        self._start.mark_step(goes_on=replayed and snapshot.goes_on)
        mujoco.mj_setState(self.model, self.data, snapshot.physics, self._full)
        self._controller.goal_position = snapshot.goal_position.copy()
        self._controller.goal_rotation = snapshot.goal_rotation.copy()
        self._controller.gripper = snapshot.gripper.copy()
        self._hidden.absent = snapshot.hidden
        mujoco.mj_step1(self.model, self.data)

    def end_prompt(self, start: Snapshot, hidden: Sequence[tuple[str, str]] = ()) -> None:
        """Restore the state before a demonstration prompt, without the hidden objects (`HiddenObjects`).

        ``hidden``: pairs of object and region of the episode's variant; ``self.task`` is the published variant.
        """
        self.highlights = ()
        absent = tuple(self._hidden.describe(name, region) for name, region in hidden)
        self.restore(start)  # bit for bit: a displaced bottle would reveal the hand's path
        self._hidden.absent = absent
        self._hidden.park()
        mujoco.mj_step1(self.model, self.data)

    def scene_hash(self) -> str:
        """Return a short hash of the present state and the fixtures' poses."""
        digest = hashlib.sha256(self.state().tobytes())
        for name, pose in sorted(self.fixture_poses().items()):
            digest.update(name.encode() + pose.tobytes())
        return digest.hexdigest()[:16]

    # --- observation ----------------------------------------------------------------------------------------

    def render(self, camera: str = "agentview") -> Image:
        """Return the image of a camera (`agentview` or `wrist`), (height, width, 3) uint8, upright."""
        return self.render_cameras([camera])[0]

    def render_cameras(self, cameras: Sequence[str]) -> list[Image]:
        """Return the images of several cameras, see `render`; drawn at the same time on idle cores."""
        from mujoco_raster.rasterizer import mean_of_four  # loads numba

        names = [_mjcf_camera(camera) for camera in cameras]
        fine = self.render_settings.quality == HIGH
        with self._rasterizers(2 if fine else 1) as (rasterizers, model, data):
            for name in self._glowing:
                lit = self.holds(Atom("turnon", (name,)))
                model.geom(f"{name}_{GLOW}").rgba = GLOW_ON if lit else GLOW_OFF
            images = at_once([partial(rasterizers[name].draw, model, data, name, self.highlights) for name in names])
        return [mean_of_four(image) if fine else image for image in images]

    def visible_bodies(self, camera: str = "agentview") -> NDArray[np.int64]:
        """Return the id of the body at each pixel of a camera's image, (height, width), -1 for none."""
        with self._rasterizers() as (rasterizers, model, data):
            name = _mjcf_camera(camera)
            geoms = rasterizers[name].draw_geoms(model, data, name)
        return np.where(geoms >= 0, model.geom_bodyid[geoms], -1)

    @contextlib.contextmanager
    def _rasterizers(self, scale: int = 1) -> Iterator[tuple[dict[str, Rasterizer], mujoco.MjModel, mujoco.MjData]]:
        """Return the rasterizers, with the visual model and its data in the present pose."""
        size = self.render_settings
        model, data = self._drawing()
        try:
            yield get_rasterizers(self._scene, scale * size.height, scale * size.width), model, data
        except RasterError as error:
            raise MemobenchError(str(error)) from error

    def _drawing(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        if self._drawn is None:
            model = copy.copy(self._scene.drawing()[0])
            self._drawn = model, mujoco.MjData(model)
        model, data = self._drawn
        for name, pose in self.fixture_poses().items():
            body = model.body(name).id
            model.body_pos[body], model.body_quat[body] = pose[:3], pose[3:]
        data.qpos[:] = self.data.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        return model, data

    def proprio(self) -> NDArray[np.float32]:
        """Return the 8-D proprioception: end-effector position (3), axis-angle (3), finger positions (2)."""
        position, rotation_vector = self.data.site_xpos[self._grip], axis_angle(self.data.xquat[self._hand])
        return np.concatenate([position, rotation_vector, self.data.qpos[robot.FINGERS]]).astype(np.float32)

    def robot_state(self) -> dict[str, dict[str, Array]]:
        """Return hand, fingers and joints as in LeRobot's ``libero``, float64.

        ``eef``: ``pos`` (3,) and ``mat`` (3, 3) of the grip site, ``quat`` xyzw (4,) of the hand's body; ``gripper``:
        ``qpos`` and ``qvel`` (2,); ``joints``: ``pos`` and ``vel`` (7,).
        """
        position, rotation = self.eef_pose()
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        return {
            "eef": {"pos": position, "quat": self.data.xquat[self._hand, [1, 2, 3, 0]], "mat": rotation},
            "gripper": {"qpos": qpos[robot.FINGERS], "qvel": qvel[robot.FINGERS]},
            "joints": {"pos": qpos[robot.ARM], "vel": qvel[robot.ARM]},
        }

    def eef_pose(self) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of the grip site, between the finger tips."""
        return self.data.site_xpos[self._grip].copy(), self.data.site_xmat[self._grip].reshape(3, 3).copy()

    @property
    def home(self) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) of the grip site after the scene has settled."""
        return self._start.home

    @property
    def absent(self) -> tuple[str, ...]:
        """Names of the hidden objects that are outside the scene."""
        return tuple(hidden.name for hidden in self._hidden.absent)

    @property
    def at_detent(self) -> bool:
        """Whether the hand is within the detent at home, which catches it at rest; strict scenes only."""
        return self._at_home is not None and self._start.at_detent()

    def gripper_opening(self) -> float:
        """Return the distance between the fingers, m."""
        first, second = self.data.qpos[robot.FINGERS]
        return float(first - second)

    def gripper_command(self) -> float:
        """Return the gripper command, from −1 (open) to 1 (closed); a control step changes it by a quarter."""
        return float(self._controller.gripper @ robot.CLOSING_SIGNS) / 2

    def body_pose(self, name: str) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of an instance or body."""
        body = self.data.body(name)
        return body.xpos.copy(), body.xmat.reshape(3, 3).copy()

    def asset_pose(self, name: str) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of an instance's `Asset` frame, with z up."""
        position, rotation = self.body_pose(name)
        upright = self.assets[name].upright
        if upright is None:
            return position, rotation
        return position, rotation @ Rotation.from_quat(upright, scalar_first=True).as_matrix()

    def site_pose(self, name: str) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of a site."""
        site = self.data.site(name)
        return site.xpos.copy(), site.xmat.reshape(3, 3).copy()

    def site_half_size(self, name: str) -> Array:
        """Return the half extents (3,) of a region's box, m."""
        return self.model.site(name).size.copy()

    def holds(self, atom: Atom) -> bool:
        """Return whether an atom of the task language is true now."""
        return (self._start if atom.predicate in SINCE_START else self.world).holds(atom)


def _mjcf_camera(camera: str) -> str:
    if camera not in MJCF_CAMERAS:
        raise MemobenchError(f"there is no camera {camera!r}; {nearest(camera, MJCF_CAMERAS)}")
    return MJCF_CAMERAS[camera]


def axis_angle(quaternion: Array) -> Array:
    """Return the rotation vector (3,) of a quaternion wxyz, computed as in robosuite and openpi."""
    # The quaternion's sign is kept: the result is continuous through a half turn, unlike a canonical form.
    w = float(np.clip(quaternion[0], -1.0, 1.0))
    norm = np.sqrt(1.0 - w * w)
    if norm < 1e-8:
        return np.zeros(3)
    return np.asarray(quaternion[1:]) * (2.0 * np.arccos(w) / norm)
