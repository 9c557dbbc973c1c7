"""What a policy is shown and what it answers: names, shapes and units, for LeRobot's configuration and for gym.

Cheap to import: no simulator, no GL.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_memobench.envs.obs_types import OBJECTS, PIXELS
from lerobot_memobench.protocol import ACTION_DIM, CAMERAS, EXECUTION, IMAGE_SIZE, PROMPT, PROPRIO_DIM
from lerobot_memobench.sim.object_layout import SIZE

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}


def policy_features(obs_type: str = PIXELS) -> dict[str, PolicyFeature]:
    """Return LeRobot's description of actions and observations, by the environment's names."""
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(IMAGE_SIZE, IMAGE_SIZE, 3))
    objects = {"environment_state": PolicyFeature(type=FeatureType.ENV, shape=(SIZE,))}
    return {
        ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,)),
        **dict.fromkeys(_pictures(obs_type), image),
        **(objects if obs_type != PIXELS else {}),
        "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(PROPRIO_DIM,)),
    }


def policy_names(obs_type: str = PIXELS) -> dict[str, str]:
    """Return what each of `policy_features` is called at the policy."""
    return {
        ACTION: ACTION,
        **_pictures(obs_type),
        **({"environment_state": OBS_ENV_STATE} if obs_type != PIXELS else {}),
        "agent_pos": OBS_STATE,
    }


def _pictures(obs_type: str) -> dict[str, str]:
    """Return the pictures' names, here and at the policy."""
    return {} if obs_type == OBJECTS else {f"pixels/{name}": f"{OBS_IMAGES}.{name}" for name in CAMERAS}


def observation_space(
    expert_action: bool, render_every: int = 1, obs_type: str = PIXELS, blind_action: bool = False
) -> spaces.Dict:
    """Return the space of observations, with the actions of the scripted expert or the blind routine on request.

    Where not every step is drawn, ``picture_step`` tells which step the pictures show.
    """
    parts: dict[str, spaces.Space[Any]] = {
        "agent_pos": spaces.Box(-np.inf, np.inf, (PROPRIO_DIM,), np.float32),
        # LeRobot passes numeric keys that it does not know on as `observation.<key>`, so a policy with a memory can
        # tell by itself when each row of a batch starts and stands still.
        "phase": spaces.Box(PROMPT, EXECUTION, (1,), np.float32),
        "step": spaces.Box(0, np.inf, (1,), np.float32),
    }
    if obs_type != OBJECTS:
        image = spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        parts["pixels"] = spaces.Dict(dict.fromkeys(CAMERAS, image))
        if render_every > 1:
            parts["picture_step"] = spaces.Box(0, np.inf, (1,), np.float32)
    if obs_type != PIXELS:
        parts["environment_state"] = spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
    if expert_action:
        parts["expert_action"] = action_space()
    if blind_action:
        parts["blind_action"] = action_space()
    return spaces.Dict(parts)


def action_space() -> spaces.Box:
    """Return the space of actions."""
    return spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)


def blank(space: spaces.Space[Any]) -> Any:
    """Return an observation of nothing: zeros of the space's shapes."""
    if isinstance(space, spaces.Dict):
        return {key: blank(part) for key, part in space.items()}
    return np.zeros(space.shape or (), space.dtype)
