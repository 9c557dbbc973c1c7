"""Refuse a checkpoint in pictures of another convention (`sim.convention`) than those that it was trained on.

The names of the cameras in the training data decide, then the dataset on this machine, then its repository. A
``rename_map`` of an evaluation changes none of them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypedDict

from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.constants import OBS_IMAGES

from lerobot_memobench.datasets.lerobot_format.layout import INFO_FILE, read_info
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import checkpoint_file, read_json, statistics_shapes
from lerobot_memobench.policies.compatibility import cameras_read
from lerobot_memobench.policies.lerobot_config import quiet
from lerobot_memobench.sim.convention import CONVENTIONS, MIRRORED, UPRIGHT, convention_of

OF_LIBERO = ("lerobot/", "HuggingFaceVLA/", "physical-intelligence/")
"""Owners of LIBERO's data on the hub; other datasets with LIBERO's name may be of this package, in its scenes."""


class TrainingData(TypedDict, total=False):
    """LeRobot's settings of the dataset of a training."""

    repo_id: str | None
    root: str | None


class TrainConfig(TypedDict, total=False):
    """The parts of a checkpoint's ``train_config.json`` that show a convention."""

    dataset: TrainingData | None
    rename_map: dict[str, str] | None


def trained_convention(path: str, policy: Any) -> tuple[str | None, str]:
    """Return the convention of the pictures that a checkpoint was trained on, None if it is not clear, and the reason.

    Args:
        path: folder of the checkpoint, or a repository. policy: its configuration.
    """
    config: Mapping[str, Any] = {}
    with suppress(MemobenchError):
        file = checkpoint_file(path, "train_config.json")
        config = {} if file is None else read_json(file, TrainConfig)
    given, dataset = {new: old for old, new in (config.get("rename_map") or {}).items()}, config.get("dataset") or {}
    cameras = [given.get(name, name) for name in cameras_read(policy, statistics_shapes(path))]
    mirrored, upright = (f"{OBS_IMAGES}.{CONVENTIONS[one]['wrist_image']}" for one in (MIRRORED, UPRIGHT))
    if mirrored in cameras:
        return MIRRORED, f"its data have {mirrored}"
    root, name = dataset.get("root") or "", dataset.get("repo_id") or ""
    if root and os.path.isfile(os.path.join(root, INFO_FILE)):  # pathlib raises at names that are too long
        with suppress(MemobenchError):
            if (stated := convention_of(read_info(Path(root))["features"])) is not None:
                return stated, f"by {root}"
    if "libero" in name.lower() and (name.startswith(OF_LIBERO) or upright not in cameras):
        return MIRRORED, f"on {name}"
    if upright in cameras and "libero" not in name.lower():
        return UPRIGHT, f"its data have {upright}"
    return None, f"its cameras are {', '.join(cameras)}, its dataset {name or 'is not named'}"


def check_convention(path: str | None, policy: Any, asked: str | None) -> None:
    """Refuse pictures of another convention than a policy's, and a default where its own is not clear.

    Args:
        path: folder of its checkpoint, or a repository; None for a policy without one.
        policy: its configuration. asked: the convention that was named; None: none, and pictures are upright.

    Raises:
        MemobenchError: naming the commands that run it.
    """
    found: str | None
    if getattr(policy, "uses_detector", False):
        found, why = UPRIGHT, "its detector reads them"
    elif path is None or not policy.image_features:
        return
    else:
        found, why = trained_convention(path, policy)
    name = path or policy.type
    command = f"lerobot eval env=memobench policy={name} convention="
    if found is None and asked is None:
        raise MemobenchError(
            f"the policy {name} may expect upright pictures or mirrored ones as LIBERO's ({why}); run "
            f"`{command}{UPRIGHT}` or `{command}{MIRRORED}`, with lerobot-eval --env.convention="
        )
    if found not in (None, asked or UPRIGHT):
        raise MemobenchError(
            f"the policy {name} expects pictures of convention={found} ({why}), and found {asked or UPRIGHT}; run "
            f"`{command}{found}`, or `lerobot-eval --env.type=memobench --policy.path={name} --env.convention={found}`"
        )


def check_lerobots_command(environment: Any) -> None:
    """Check the checkpoint that the command line of ``lerobot-eval`` names; a training may begin with any."""
    path = parser.get_path_arg("policy")
    if path is None or any(word.startswith("--dataset.") for word in sys.argv):
        return
    with quiet():
        policy = PreTrainedConfig.from_pretrained(path, cli_overrides=parser.get_cli_overrides("policy") or [])
    named = parser.parse_arg("env.convention") is not None or environment.convention != UPRIGHT
    check_convention(path, policy, environment.convention if named else None)
