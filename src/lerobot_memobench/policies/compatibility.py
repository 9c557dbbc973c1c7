"""Check that a policy's inputs fit an environment's observations."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import statistics_shapes
from lerobot_memobench.protocol import ENDED, NO_CLOCK

if TYPE_CHECKING:
    from lerobot.configs import PolicyFeature
    from lerobot.configs.policies import PreTrainedConfig


SIZE_COUNTS = {
    "act": None,
    "diffusion": "resize_shape",
    "gaussian_actor": None,
    "multi_task_dit": "image_resize_shape",
    "smolvla": "resize_imgs_with_padding",
    "tdmpc": None,
    "vla_jepa": "resize_images_to",
    "vqbet": None,
    "xvla": "resize_imgs_with_padding",
}
"""LeRobot's policies that read pictures in the environment's size -> their setting that resizes pictures, if any. All
others resize every picture to a fixed size."""
EMPTY_CAMERA = f"{OBS_IMAGES}.empty_camera_"
"""Prefix of the cameras that LeRobot's ``policy.empty_cameras`` adds; no environment has them."""


def cure(missing: str, observed: Collection[str]) -> str:
    """Return advice on a missing observation, for the end of an error message.

    Args:
        missing: its name at the policy. observed: the names of the present ones.
    """
    cameras = ", ".join(key for key in observed if key.startswith(f"{OBS_IMAGES}."))
    if missing == OBS_ENV_STATE:
        return f"set env.obs_type={OBJECTS}, or {BOTH}."
    if not cameras and OBS_ENV_STATE in observed:
        return f"set env.obs_type={PIXELS}, or {BOTH}."
    return f"it has {cameras or 'none'}. Map its names with --rename_map."


def check_actions(path: str, policy: Any) -> None:
    """Refuse a policy whose actions are not those of the environment whatever their number.

    Raises:
        MemobenchError: it is an XVLA of absolute poses.
    """
    if policy.type == "xvla" and policy.action_mode == "ee6d":
        raise MemobenchError(
            f"the policy {path} predicts absolute poses of two hands (action_mode=ee6d, as LIBERO's XVLA), and the "
            "environment takes relative motions of one; train it with policy.action_mode=auto on a dataset of this "
            "environment"
        )


def check_features(
    path: str, policy: PreTrainedConfig, shown: Mapping[str, PolicyFeature], renamed: Mapping[str, str]
) -> None:
    """Refuse other cameras, or vectors or pictures of other sizes, than a checkpoint was trained on.

    LeRobot compares only the names of cameras, and only without a ``rename_map``. Policies that pad vectors, and those
    that read pictures of any size, would act on inputs unlike their training data.

    Args:
        path: folder of the checkpoint, or a repository.
        policy: its configuration.
        shown: the environment's features by their names at the policy, and its action.
        renamed: LeRobot's ``rename_map``: names of the environment -> names of the policy.

    Raises:
        MemobenchError: an input differs.
    """
    check_actions(path, policy)
    if getattr(policy, "perception", None) == "any" or not policy.input_features:
        return
    trained = statistics_shapes(path)
    there = {renamed.get(name, name): feature for name, feature in shown.items()}
    original = {renamed.get(name, name): name for name in shown}
    _check_cameras(path, cameras_read(policy, trained), there, original)
    features = {
        OBS_STATE: policy.robot_state_feature,
        OBS_ENV_STATE: policy.env_state_feature if OBS_ENV_STATE in there else None,  # else see `check_obs_type`
        ACTION: policy.action_feature,
    }
    for name, feature in features.items():
        length = _length(policy, name, feature, trained)
        if name == OBS_STATE and length is not None and name not in there:
            raise MemobenchError(
                f"the policy {path} reads {name} ({length} numbers), and the environment has {_list(original)}; map "
                "its names with --rename_map, or train on a dataset of this environment"
            )
        if length is not None and there[name].shape != (length,):
            raise MemobenchError(
                f"the policy {path} has {name} of {length} numbers, and the environment has {there[name].shape[0]}; "
                "train it on a dataset of this environment"
            )
    _check_sizes(path, policy, there)


def cameras_read(policy: Any, trained: Mapping[str, Any]) -> list[str]:
    """Return the cameras that a policy needs.

    A policy that fills missing pictures may list cameras of the checkpoint that its training began with; it needs those
    of its training data, which its statistics name. Without such names, LeRobot's ``policy.empty_cameras`` fills the
    last ones.
    """
    cameras = list(policy.image_features)
    if not hasattr(policy, "empty_cameras"):
        return cameras
    named = [name for name in cameras if not name.startswith(EMPTY_CAMERA)]
    filled = max(0, policy.empty_cameras - (len(cameras) - len(named)))
    return [name for name in cameras if name in trained] or named[: max(1, len(named) - filled)]


def _check_cameras(
    path: str, cameras: list[str], there: Mapping[str, PolicyFeature], original: Mapping[str, str]
) -> None:
    missing = [name for name in cameras if name not in there]
    if not missing:
        return
    free = [original[name] for name in there if name.startswith(f"{OBS_IMAGES}.") and name not in cameras]
    found = f"the policy {path} reads {', '.join(cameras)}, and the environment has {_list(original)}"
    if len(free) < len(missing):
        raise MemobenchError(
            f"{found}, no picture for {', '.join(missing[len(free) :])}; train without it, or on a dataset of "
            "this environment"
        )
    mapped = {name: known for known, name in original.items() if known in cameras and known != name}
    guess = json.dumps(mapped | dict(zip(free, missing, strict=False)))
    raise MemobenchError(f"{found}; map its names, for example by --rename_map='{guess}'")


def _list(original: Mapping[str, str]) -> str:
    return ", ".join(name for name in original.values() if name != ACTION)


def _length(policy: Any, name: str, feature: PolicyFeature | None, trained: Mapping[str, Any]) -> int | None:
    """Return the length of a state or an action in a policy's training data; None if it is unknown.

    A policy that pads them may list the padded length, or that of the checkpoint that its training began with.
    """
    if feature is None:
        return None
    padded = getattr(policy, "max_state_dim" if name == OBS_STATE else "max_action_dim", None)
    if name in trained and len(trained[name]) == 1:
        return int(trained[name][0])
    return None if padded is not None and feature.shape == (padded,) else int(feature.shape[0])


def keeps_sizes(policy: PreTrainedConfig) -> bool:
    """Return whether a policy reads pictures in the size of its training data alone."""
    resizes = SIZE_COUNTS.get(policy.type)
    return policy.type in SIZE_COUNTS and (resizes is None or getattr(policy, resizes) is None)


def _check_sizes(path: str, policy: PreTrainedConfig, there: Mapping[str, PolicyFeature]) -> None:
    if not keeps_sizes(policy):
        return
    resizes = SIZE_COUNTS[policy.type]
    for name, feature in policy.image_features.items():
        if name in there and tuple(there[name].shape) != tuple(feature.shape):
            here, seen = (" x ".join(map(str, shape[1:])) for shape in (there[name].shape, feature.shape))
            height, width = feature.shape[1:]
            also = "" if resizes is None else f", or with --policy.{resizes} for both"
            raise MemobenchError(
                f"the policy {path} was trained on {name} of {seen} pixels and does not resize it, and the environment "
                f"has {here}; set env.observation_height={height} and env.observation_width={width}, or train it on "
                f"pictures of that size{also}"
            )


Clock = tuple[int, int]
"""Phase and step of an observation (`lerobot_memobench.protocol`)."""


def begins_episode(last: Clock | None, now: Clock) -> bool:
    """Return whether an observation is the first of an episode, given the clock of the one before."""
    return last is None or (now[1] != ENDED and (now < last or last[1] == ENDED))


def is_frozen(last: Clock | None, now: Clock) -> bool:
    """Return whether an observation repeats the one before, because the episode has ended."""
    return now[1] == ENDED or (now == last and now[1] != NO_CLOCK)
