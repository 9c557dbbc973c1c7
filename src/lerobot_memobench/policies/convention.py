"""Choose the convention of pictures (`sim.convention`) for a checkpoint: that of its training; refuse any other.

The names of the cameras in its training data decide, then the dataset on this machine, then its repository. They do not
depend on the ``rename_map`` of an evaluation.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.constants import OBS_IMAGES

from lerobot_memobench.datasets.lerobot_format.layout import INFO_FILE, read_info
from lerobot_memobench.envs.episode_log import UNKNOWN_POLICY, Acting
from lerobot_memobench.envs.observations import check_obs_type, policy_features, policy_names
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.policies.checkpoint import statistics_shapes, trained_names, training_of
from lerobot_memobench.policies.compatibility import cameras_read, check_actions
from lerobot_memobench.policies.lerobot_config import acting, quiet, read_lerobots_config
from lerobot_memobench.sim.convention import MIRRORED, UPRIGHT, WRIST, convention_of

logger = logging.getLogger(__name__)

OF_LIBERO = ("lerobot/", "HuggingFaceVLA/", "physical-intelligence/")
"""Owners of LIBERO's data on the hub. Other datasets of that name may be of this package."""

LEROBOTS_COMMANDS = {"lerobot-train": TrainPipelineConfig, "lerobot-eval": EvalPipelineConfig}
"""LeRobot's command -> its configuration."""


def trained_convention(path: str, policy: Any) -> tuple[str | None, str]:
    """Return the convention of a checkpoint (folder or repository), None if it is unclear, and what shows it."""
    in_data = {new: old for old, new in trained_names(path).items()}
    cameras = [in_data.get(name, name) for name in cameras_read(policy, statistics_shapes(path))]
    has = {convention: f"{OBS_IMAGES}.{wrist}" in cameras for convention, wrist in WRIST.items()}
    given = training_of(path).get("dataset") or {}
    root, name = given.get("root") or "", given.get("repo_id") or ""
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
    path: str | None, policy: Any, asked: str | None, rename_map: Mapping[str, str] | None = None
) -> str | None:
    """Return the convention of the pictures for a policy: the one that was asked for, else that of its training.

    None if none was and the policy reads no pictures, or has no checkpoint.

    Args:
        path: folder or repository of its checkpoint, or None. policy: its configuration.
        asked: the convention that was named, None if none was.
        rename_map: of the evaluation. It may name the wrist camera of a convention, but it does not mirror pictures.

    Raises:
        MemobenchError: another one than the policy's was asked for, or none was and the policy's is unclear; it names
            the commands that run it.
    """
    if asked is not None:
        check_choice("convention", asked, [*WRIST])
    found: str | None = UPRIGHT
    if getattr(policy, "uses_detector", False):
        why = "its detector reads them"
    elif path is None or not policy.image_features:
        return asked
    else:
        found, why = trained_convention(path, policy)
    name = path or policy.type
    command = f"lerobot eval env=memobench policy={name} convention="
    if found is None and asked is None:
        raise MemobenchError(
            f"the policy {name} may expect upright pictures or mirrored ones as LIBERO's ({why}); run "
            f"`{command}{UPRIGHT}` or `{command}{MIRRORED}`, with lerobot-eval --env.convention="
        )
    mapped = [convention for convention, wrist in WRIST.items() if f"{OBS_IMAGES}.{wrist}" in (rename_map or {})]
    for other in (asked, *mapped):
        if found is not None and other not in (None, found):
            where = "" if other == asked else " in rename_map, which does not mirror pictures"
            raise MemobenchError(
                f"the policy {name} expects pictures of convention={found} ({why}), and found {other}{where}; run "
                f"`{command}{found}`, or `lerobot-eval --env.type=memobench --policy.path={name} "
                f"--env.convention={found}`"
            )
    if asked is None and found != UPRIGHT:
        logger.warning("pictures have convention=%s, as in the training of %s (%s)", found, name, why)
    return asked or found


def prepare_lerobots_command(environment: Any) -> tuple[PreTrainedConfig | None, Acting]:
    """Return the policy on the command line of ``lerobot-eval`` or ``lerobot-train``, and its description for the log.

    The configuration is None elsewhere; the description is known in evaluations. Set the convention for the checkpoint
    of an evaluation; a training may begin with any.

    Raises:
        MemobenchError: as of `chosen_convention` and `check_obs_type`; or LeRobot's command would run the policy in
            LIBERO's pipelines.
    """
    command = Path(sys.argv[0]).name.replace("_", "-")
    kind = next((kind for name, kind in LEROBOTS_COMMANDS.items() if command.startswith(name)), None)
    if kind is None:
        return None, UNKNOWN_POLICY
    with quiet():
        config = read_lerobots_config(kind, sys.argv[1:])
    path, policy = parser.get_path_arg("policy"), config.policy
    if not isinstance(config, EvalPipelineConfig) or policy is None:
        return policy, UNKNOWN_POLICY
    check_obs_type(policy, environment.obs_type, environment.suite)
    if path is None:
        return policy, acting(policy, None, None, environment.settings)
    check_actions(path, policy)
    if policy.type == "xvla":
        raise MemobenchError(
            "lerobot-eval runs every XVLA with the processors of LIBERO, which mirror a picture and convert actions; "
            f"run `lerobot eval env=memobench policy={path}`"
        )
    asked = _named_convention() or (MIRRORED if environment.camera_name_mapping else None)
    found = chosen_convention(path, policy, asked, config.rename_map)
    if found not in (None, environment.convention):  # with the names of its pictures
        names = {"features": policy_features(), "features_map": policy_names()}
        vars(environment).update(vars(replace(environment, **names, convention=found)))
    return policy, acting(policy, path, None, environment.settings)


def _named_convention() -> str | None:
    """Return the convention that LeRobot's command line, or the file of its ``config_path``, names; None without it."""
    file = parser.parse_arg("config_path")
    found: Any = yaml.safe_load(Path(file).read_bytes()) if file and Path(file).is_file() else None
    for part in ("env", "convention"):
        found = found.get(part) if isinstance(found, dict) else None
    return parser.parse_arg("env.convention") or found
