"""Refuse a checkpoint in pictures of another convention (`sim.convention`) than those of its training.

The names of the cameras in its training data decide, then the dataset on this machine, then its repository. They do not
depend on the ``rename_map`` of an evaluation.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.constants import OBS_IMAGES

from lerobot_memobench.datasets.lerobot_format.layout import INFO_FILE, read_info
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.policies.checkpoint import TrainConfig, checkpoint_file, read_json, statistics_shapes
from lerobot_memobench.policies.compatibility import cameras_read
from lerobot_memobench.policies.lerobot_config import quiet, read_lerobots_config
from lerobot_memobench.sim.convention import MIRRORED, UPRIGHT, WRIST, convention_of

OF_LIBERO = ("lerobot/", "HuggingFaceVLA/", "physical-intelligence/")
"""Owners of LIBERO's data on the hub. Other datasets of that name may be of this package."""

LEROBOTS_COMMANDS = {"lerobot-train": TrainPipelineConfig, "lerobot-eval": EvalPipelineConfig}
"""LeRobot's command -> its configuration."""


def trained_convention(path: str, policy: Any) -> tuple[str | None, str]:
    """Return the convention of a checkpoint (folder or repository), None if it is unclear, and what shows it."""
    training: dict[str, Any] = {}
    with suppress(MemobenchError):
        file = checkpoint_file(path, "train_config.json")
        training = {} if file is None else read_json(file, TrainConfig)
    in_data = {new: old for old, new in (training.get("rename_map") or {}).items()}
    cameras = [in_data.get(name, name) for name in cameras_read(policy, statistics_shapes(path))]
    has = {convention: f"{OBS_IMAGES}.{wrist}" in cameras for convention, wrist in WRIST.items()}
    given = training.get("dataset") or {}
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


def check_convention(path: str | None, policy: Any, asked: str | None, usual: str = UPRIGHT) -> None:
    """Refuse pictures of another convention than a policy's, and the suite's by default if its own is unclear.

    Args:
        path: folder or repository of its checkpoint, or None. policy: its configuration.
        asked: the convention that was named; None: none was, and pictures are as is usual in the suite.
        usual: convention of the suite.

    Raises:
        MemobenchError: naming the commands that run it.
    """
    check_choice("convention", asked or usual, [*WRIST])
    found: str | None = UPRIGHT
    if getattr(policy, "uses_detector", False):
        why = "its detector reads them"
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
    if found not in (None, asked or usual):
        raise MemobenchError(
            f"the policy {name} expects pictures of convention={found} ({why}), and found {asked or usual}; run "
            f"`{command}{found}`, or `lerobot-eval --env.type=memobench --policy.path={name} --env.convention={found}`"
        )


def check_lerobots_command(environment: Any) -> PreTrainedConfig | None:
    """Return the configuration of the policy on the command line of ``lerobot-eval`` or ``lerobot-train``, else None.

    The checkpoint of an evaluation is checked; a training may begin with any.
    """
    command = Path(sys.argv[0]).name.replace("_", "-")
    kind = next((kind for name, kind in LEROBOTS_COMMANDS.items() if command.startswith(name)), None)
    if kind is None:
        return None
    with quiet():
        policy = read_lerobots_config(kind, sys.argv[1:]).policy
    path = parser.get_path_arg("policy")
    if kind is TrainPipelineConfig or path is None:
        return policy
    usual = environment.settings.usual["convention"]
    named = parser.parse_arg("env.convention") is not None or environment.convention != usual
    check_convention(path, policy, environment.convention if named else None, usual)
    return policy
