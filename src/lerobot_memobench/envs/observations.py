"""Observations and actions: names, shapes, units, the inputs of policies, and rendering on demand.

Importing this module loads neither the simulator nor LeRobot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lerobot_memobench.constants import ACTION_DIM, CONTROL_HZ, ENDED, EXECUTION, PROMPT, PROMPT_HORIZON, PROPRIO_DIM
from lerobot_memobench.envs.settings import BOTH, DEFAULTS, OBJECTS, PIXELS, EnvSettings
from lerobot_memobench.envs.video import annotate
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.convention import in_convention
from lerobot_memobench.sim.object_layout import BOUNDS, FIELDS, SIZE, SLOTS
from lerobot_memobench.tasks.task import LIBERO_SUITES, PUBLISHED

if TYPE_CHECKING:
    from lerobot.configs import PolicyFeature

    from lerobot_memobench.envs.episode import Episode
    from mujoco_raster.drawlist import Image

ROBOT_STATE: dict[str, dict[str, tuple[int, ...]]] = {
    "eef": {"pos": (3,), "quat": (4,), "mat": (3, 3)},
    "gripper": {"qpos": (2,), "qvel": (2,)},
    "joints": {"pos": (7,), "vel": (7,)},
}
"""Shapes of ``robot_state``, see `Simulation.robot_state`."""

SPARSE, CHECKPOINTS = "sparse", "checkpoints"
REWARDS = (SPARSE, CHECKPOINTS)  # values of `reward`; see `env.MemobenchEnv`

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}

# --- inputs of a policy ---

PIXEL_INPUT, DETECTIONS = "pixels", "detections"
PRIVILEGED, SIMULATOR = "privileged object state", "privileged simulator state"
MEMORY_TEXT, NO_INPUT = "oracle memory text", "nothing"
"""Names of policy inputs in reports. Detections are the objects that a detector finds in pixels."""

READ_OBJECTS = ("act", "diffusion", "tdmpc", "gaussian_actor")
"""LeRobot policies that read `observation.environment_state` if trained on it; the others ignore it."""


def obs_type_of(policy: Any) -> str | None:
    """Return the ``obs_type`` that a policy's configuration needs; None if unknown, or if any works.

    ``uses_detector`` means pixels; otherwise ``perception`` (`pixels`, `objects` or `any`) decides, if declared.
    """
    if getattr(policy, "uses_detector", False):
        return PIXELS
    perception = getattr(policy, "perception", None)
    if policy is None or perception is not None:
        return {"objects": OBJECTS, "pixels": PIXELS}.get(str(perception))
    objects = policy.env_state_feature is not None and not _ignores_objects(policy)
    if policy.image_features:
        return BOTH if objects else PIXELS
    return OBJECTS if objects else None


def _ignores_objects(policy: Any) -> bool:
    return type(policy).__module__.startswith("lerobot.") and policy.type not in READ_OBJECTS


def check_obs_type(policy: Any, obs_type: str, suite: str = PUBLISHED) -> None:
    """Raise `MemobenchError` unless an ``obs_type`` contains the inputs of a policy; LIBERO's have images alone."""
    needed = obs_type_of(policy)
    if needed is not None and obs_type not in (needed, BOTH):
        wanted = BOTH if needed == BOTH else f"{needed} or {BOTH}"
        extra = "" if needed == PIXELS else f" ({PRIVILEGED})"
        if suite in LIBERO_SUITES:
            raise MemobenchError(
                f"{policy.type} reads more than images{extra}, and suite={suite} has images alone; evaluate it in "
                "memory tasks, or name a policy that reads images"
            )
        raise MemobenchError(f"env.obs_type is {obs_type}, which lacks inputs of the policy{extra}; set it to {wanted}")


def policy_inputs(policy: Any, obs_type: str, oracle_memory: bool = False) -> str:
    """Return the names of a policy's inputs, without the arm's state: its declared ``inputs``, else those of LeRobot.

    ``policy`` is a configuration or its class; an unknown one reads everything in ``obs_type``.
    """
    inputs = getattr(policy, "inputs", None)
    if not isinstance(inputs, tuple):
        features = getattr(policy, "input_features", None) or {}
        types = {getattr(feature.type, "value", feature.type) for feature in features.values()}
        everything = not types & {"VISUAL", "ENV"}
        pixels = obs_type != OBJECTS and (everything or "VISUAL" in types)
        objects = obs_type != PIXELS and not _ignores_objects(policy) and (everything or "ENV" in types)
        inputs = (PIXEL_INPUT,) * pixels + (PRIVILEGED,) * objects
    return ", ".join(inputs + (MEMORY_TEXT,) * oracle_memory) or NO_INPUT


def chooses_inputs(policy: object) -> bool:
    """Return whether a policy's configuration declares its inputs by ``perception``."""
    return getattr(policy, "perception", None) is not None


def reads_prompt(policy: object) -> bool:
    """Return whether a policy's configuration, or its class, declares ``reads_prompt``."""
    return bool(getattr(policy, "reads_prompt", False))


# --- shapes ---


def policy_features(settings: EnvSettings = DEFAULTS) -> dict[str, PolicyFeature]:
    """Return LeRobot's features of actions and observations, by the environment's names."""
    from lerobot.configs import FeatureType, PolicyFeature

    image = (settings.observation_height, settings.observation_width, 3)
    known = {
        "action": PolicyFeature(FeatureType.ACTION, (ACTION_DIM,)),
        "environment_state": PolicyFeature(FeatureType.ENV, (SIZE,)),
        "agent_pos": PolicyFeature(FeatureType.STATE, (PROPRIO_DIM,)),
    }
    return {name: known.get(name, PolicyFeature(FeatureType.VISUAL, image)) for name in policy_names(settings)}


def policy_names(settings: EnvSettings = DEFAULTS) -> dict[str, str]:
    """Return the environment's name -> the policy's name of each feature."""
    images = () if settings.obs_type == OBJECTS else settings.images.values()
    return {
        "action": "action",
        **{f"pixels/{name}": f"observation.images.{name}" for name in images},
        **({"environment_state": "observation.environment_state"} if settings.obs_type != PIXELS else {}),
        "agent_pos": "observation.state",
    }


def observation_space(settings: EnvSettings, longest: int) -> spaces.Dict:
    """Return the space of observations; an execution has at most ``longest`` control steps."""
    reach = np.repeat(np.array([3.0, 2 * np.pi, 0.1], np.float32), (3, 3, 2))  # m, rad, m
    longest += (1 + settings.reshow) * PROMPT_HORIZON + settings.longest_interference
    parts: dict[str, spaces.Space[Any]] = {
        "agent_pos": spaces.Box(-reach, reach, (PROPRIO_DIM,), np.float32),
        # LeRobot passes unknown numeric keys to the policy as `observation.<key>`. From these two, a policy with a
        # memory recognises in each row of a batch when an episode starts and when it is frozen.
        "phase": spaces.Box(PROMPT, EXECUTION, (1,), np.float32),
        "step": spaces.Box(ENDED, longest, (1,), np.float32),
    }
    if settings.obs_type != OBJECTS:
        image = spaces.Box(0, 255, (settings.observation_height, settings.observation_width, 3), np.uint8)
        parts["pixels"] = spaces.Dict(dict.fromkeys(settings.images.values(), image))
    if settings.obs_type != PIXELS:
        low, high = (np.tile(np.repeat(ends, [*FIELDS.values()]), SLOTS) for ends in zip(*BOUNDS.values(), strict=True))
        parts["environment_state"] = spaces.Box(low.astype(np.float32), high.astype(np.float32), (SIZE,), np.float32)
    if settings.robot_state:
        parts["robot_state"] = spaces.Dict(
            {
                name: spaces.Dict({key: spaces.Box(-np.inf, np.inf, shape, np.float64) for key, shape in group.items()})
                for name, group in ROBOT_STATE.items()
            }
        )
    for name in ("expert_action", "blind_action"):
        if getattr(settings, name):
            parts[name] = action_space()
    return spaces.Dict(parts)


def action_space() -> spaces.Space[NDArray[np.float32]]:
    """Return the space of actions."""
    return spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)


def blank(space: spaces.Space[Any]) -> Any:
    """Return zeros in the shapes of a space."""
    if isinstance(space, spaces.Dict):
        return {key: blank(part) for key, part in space.items()}
    return np.zeros(space.shape or (), space.dtype)


# --- contents ---


class Observer:
    """Render images and compute objects only for frames that are read.

    While they are not ``needed`` by the policy, observations repeat an earlier frame, except for the first and the last
    frame of the execution, and the frame before which memory is corrupted.
    """

    def __init__(self, settings: EnvSettings) -> None:
        self._convention, self._mapping = settings.convention, settings.camera_name_mapping
        self._has_images, self._has_objects = settings.obs_type != OBJECTS, settings.obs_type != PIXELS
        self.needed = True

    def begin(self, episode: Episode) -> None:
        """Observe the first frame of an episode."""
        self.needed = True
        self._image_step: int | None = None
        self._images_at_rest = self._objects_at_rest = False
        self.observe(episode, recorded=False)

    def observe(self, episode: Episode, *, recorded: bool) -> None:
        """Observe the current frame if it is needed; ``recorded``: it is part of a video."""
        always = episode.done or episode.step_index == episode.exec_start or episode.corrupts
        if not episode.at_rest:
            self._images_at_rest = self._objects_at_rest = False
        if self._has_objects and (always or self.needed) and not self._objects_at_rest:
            self._objects = episode.objects()
            self._objects_at_rest = episode.at_rest
        if self._has_images and (always or self.needed or recorded):
            self._render(episode)

    def _render(self, episode: Episode) -> None:
        if not self._images_at_rest:  # render a scene at rest once
            self._images: dict[str, Image] = episode.images()
        self._images_at_rest = episode.at_rest
        self._image_step = episode.step_index

    def observation(self) -> dict[str, Any]:
        """Return the images and objects of the observation, see `observation_space`."""
        observation: dict[str, Any] = {}
        if self._has_images:
            observation["pixels"] = in_convention(self._images, self._convention, self._mapping)
        if self._has_objects:
            observation["environment_state"] = self._objects.copy()  # may be returned again
        return observation

    def frame(self, episode: Episode) -> NDArray[np.uint8]:
        """Return both annotated cameras: last rendered, or rendered now if observations contain no images."""
        if not self._has_images and self._image_step != episode.step_index:
            self._render(episode)
        return annotate(self._images, episode)
