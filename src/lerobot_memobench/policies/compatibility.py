"""Check that a policy fits an environment: its observations, and the convention (`sim.convention`) of its images."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_memobench.datasets.episodes import read_info
from lerobot_memobench.datasets.layout import INFO_FILE
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.policies.checkpoint import statistics_shapes, trained_names, training_of
from lerobot_memobench.sim.convention import MIRRORED, UPRIGHT, WRIST, convention_of

if TYPE_CHECKING:
    from lerobot.configs import PolicyFeature
    from lerobot.configs.policies import PreTrainedConfig

logger = logging.getLogger(__name__)

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
"""LeRobot's policies that read images in the environment's size -> their setting that resizes images, if any. All
others resize every image to a fixed size."""
EMPTY_CAMERA = f"{OBS_IMAGES}.empty_camera_"
"""Prefix of the cameras that LeRobot's ``policy.empty_cameras`` adds; no environment has them."""
OF_LIBERO = ("lerobot/", "HuggingFaceVLA/", "physical-intelligence/")
"""Owners of LIBERO's data on the hub. Other datasets of that name may be of this package."""


# --- observations ---


def hint(missing: str, observed: Collection[str]) -> str:
    """Return advice on an observation that a policy misses among the observed ones, for the end of a message."""
    cameras = ", ".join(key for key in observed if key.startswith(f"{OBS_IMAGES}."))
    if missing == OBS_ENV_STATE:
        return f"set env.obs_type={OBJECTS}, or {BOTH}."
    if not cameras and OBS_ENV_STATE in observed:
        return f"set env.obs_type={PIXELS}, or {BOTH}."
    return f"it has {cameras or 'none'}. Map its names with --rename_map."


def check_actions(path: str, policy: Any) -> None:
    """Refuse an XVLA of absolute poses, whose actions are not those of the environment whatever their number."""
    if policy.type == "xvla" and policy.action_mode == "ee6d":
        raise MemobenchError(
            f"the policy {path} predicts absolute poses of two hands (action_mode=ee6d, as LIBERO's XVLA), and the "
            "environment takes relative motions of one; train it with policy.action_mode=auto on a dataset of this "
            "environment"
        )


def check_features(
    path: str, policy: PreTrainedConfig, shown: Mapping[str, PolicyFeature], renamed: Mapping[str, str]
) -> None:
    """Refuse other cameras, or vectors or images of other sizes, than a checkpoint was trained on.

    LeRobot compares only the names of cameras, and only without a ``rename_map``. ``shown`` are the features of the
    environment's observations and action; ``renamed`` maps their names to the policy's, as LeRobot's ``rename_map``.
    """
    check_actions(path, policy)
    if getattr(policy, "perception", None) == "any" or not policy.input_features:
        return
    trained = statistics_shapes(path)
    available = {renamed.get(name, name): feature for name, feature in shown.items()}
    original = {renamed.get(name, name): name for name in shown}
    _check_cameras(path, cameras_read(policy, trained), original)
    features = {
        OBS_STATE: policy.robot_state_feature,
        OBS_ENV_STATE: policy.env_state_feature if OBS_ENV_STATE in available else None,  # else see `check_obs_type`
        ACTION: policy.action_feature,
    }
    for name, feature in features.items():
        length = None if feature is None else _length(policy, name, feature, trained)
        if name == OBS_STATE and length is not None and name not in available:
            raise MemobenchError(
                f"the policy {path} reads {name} ({length} numbers), and the environment has {_list(original)}; map "
                "its names with --rename_map, or train on a dataset of this environment"
            )
        if length is not None and available[name].shape != (length,):
            raise MemobenchError(
                f"the policy {path} has {name} of {length} numbers, and the environment has {available[name].shape[0]}"
                "; train it on a dataset of this environment"
            )
    _check_sizes(path, policy, available)


def cameras_read(policy: Any, trained: Mapping[str, Any]) -> list[str]:
    """Return the cameras that a policy needs.

    A policy that fills missing images may list cameras of the checkpoint that its training began with; it needs those
    of its training data, which its statistics name. LeRobot's ``policy.empty_cameras`` fills the last ones.
    """
    cameras = list(policy.image_features)
    if not hasattr(policy, "empty_cameras"):
        return cameras
    real = [name for name in cameras if not name.startswith(EMPTY_CAMERA)]
    filled = max(0, policy.empty_cameras - (len(cameras) - len(real)))
    return [name for name in cameras if name in trained] or real[: max(1, len(real) - filled)]


def _check_cameras(path: str, cameras: list[str], original: Mapping[str, str]) -> None:
    missing = [name for name in cameras if name not in original]
    if not missing:
        return
    free = [known for name, known in original.items() if name.startswith(f"{OBS_IMAGES}.") and name not in cameras]
    inputs = f"the policy {path} reads {', '.join(cameras)}, and the environment has {_list(original)}"
    if len(free) < len(missing):
        raise MemobenchError(
            f"{inputs}, no image for {', '.join(missing[len(free) :])}; train without it, or on a dataset of "
            "this environment"
        )
    mapped = {name: known for known, name in original.items() if known in cameras and known != name}
    guess = json.dumps(mapped | dict(zip(free, missing, strict=False)))
    raise MemobenchError(f"{inputs}; map its names, for example by --rename_map='{guess}'")


def _list(original: Mapping[str, str]) -> str:
    return ", ".join(name for name in original.values() if name != ACTION)


def _length(policy: Any, name: str, feature: PolicyFeature, trained: Mapping[str, Any]) -> int | None:
    """Return the length of a vector in a policy's training data; None if it is unknown."""
    # A policy that pads vectors may list the padded length, or that of the checkpoint that its training began with.
    padded = getattr(policy, "max_state_dim" if name == OBS_STATE else "max_action_dim", None)
    if name in trained and len(trained[name]) == 1:
        return int(trained[name][0])
    return None if padded is not None and feature.shape == (padded,) else int(feature.shape[0])


def keeps_sizes(policy: PreTrainedConfig) -> bool:
    """Return whether a policy reads images in the size of its training data alone."""
    resizes = SIZE_COUNTS.get(policy.type)
    return policy.type in SIZE_COUNTS and (resizes is None or getattr(policy, resizes) is None)


def _check_sizes(path: str, policy: PreTrainedConfig, available: Mapping[str, PolicyFeature]) -> None:
    for name, feature in policy.image_features.items() if keeps_sizes(policy) else ():
        if name in available and tuple(available[name].shape) != tuple(feature.shape):
            here, seen = (" x ".join(map(str, shape[1:])) for shape in (available[name].shape, feature.shape))
            height, width = feature.shape[1:]
            resizes = SIZE_COUNTS[policy.type]
            also = "" if resizes is None else f", or with --policy.{resizes} for both"
            raise MemobenchError(
                f"the policy {path} was trained on {name} of {seen} pixels and does not resize it, and the environment "
                f"has {here}; set env.observation_height={height} and env.observation_width={width}, or train it on "
                f"images of that size{also}"
            )


# --- the convention of images ---


def trained_convention(path: str, policy: Any) -> tuple[str | None, str]:
    """Return the convention of a checkpoint (folder or repository), None if it is unclear, and the evidence.

    The names of the cameras in its training data decide, then the dataset on this machine, then its repository.
    """
    in_data = {new: old for old, new in trained_names(path).items()}
    cameras = [in_data.get(name, name) for name in cameras_read(policy, statistics_shapes(path))]
    has = {convention: f"{OBS_IMAGES}.{wrist}" in cameras for convention, wrist in WRIST.items()}
    dataset = training_of(path).get("dataset") or {}
    root, name = dataset.get("root") or "", dataset.get("repo_id") or ""
    why = f"cameras {', '.join(cameras)}; dataset {name or 'unknown'}"
    if has[MIRRORED]:
        return MIRRORED, why
    if root and os.path.isfile(os.path.join(root, INFO_FILE)):  # pathlib raises at names that are too long
        with suppress(MemobenchError):
            if (stated := convention_of(read_info(Path(root))["features"])) is not None:
                return stated, why
    if "libero" in name.lower():
        return (None if has[UPRIGHT] and not name.startswith(OF_LIBERO) else MIRRORED), why
    return (UPRIGHT if has[UPRIGHT] else None), why


def chosen_convention(
    path: str | None, policy: Any, requested: str | None, rename_map: Mapping[str, str] | None = None
) -> str | None:
    """Return the convention of the images for a policy: ``requested``, else that of its training.

    None if the policy reads no images, or has no checkpoint. Another one than the policy's is refused; so is none if
    the policy's is unclear, and a ``rename_map`` that names the wrist camera of another convention.
    """
    if requested is not None:
        check_choice("convention", requested, [*WRIST])
    own: str | None = UPRIGHT
    if getattr(policy, "uses_detector", False):
        why = "its detector reads them"
    elif path is None or not policy.image_features:
        return requested
    else:
        own, why = trained_convention(path, policy)
    name = path or policy.type
    command = f"lerobot eval env=memobench policy={name} convention="
    if own is None and requested is None:
        raise MemobenchError(
            f"the policy {name} may expect upright images or mirrored ones as LIBERO's ({why}); run "
            f"`{command}{UPRIGHT}` or `{command}{MIRRORED}`, with lerobot-eval --env.convention="
        )
    mapped = [convention for convention, wrist in WRIST.items() if f"{OBS_IMAGES}.{wrist}" in (rename_map or {})]
    for other in (requested, *mapped):
        if own is not None and other not in (None, own):
            where = "" if other == requested else " in rename_map, which does not mirror images"
            raise MemobenchError(
                f"the policy {name} expects images of convention={own} ({why}), and found {other}{where}; run "
                f"`{command}{own}`, or `lerobot-eval --env.type=memobench --policy.path={name} "
                f"--env.convention={own}`"
            )
    if requested is None and own != UPRIGHT:
        logger.warning("images have convention=%s, as in the training of %s (%s)", own, name, why)
    return requested or own
