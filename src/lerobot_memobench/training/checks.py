"""Refuse what a training cannot do, before it starts."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import yaml
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_memobench.datasets.lerobot_format.layout import INFO_FILE, read_info
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import check_fetched
from lerobot_memobench.policies.compatibility import check_features
from lerobot_memobench.policies.memobench_mem.memory import NONE, read_settings
from lerobot_memobench.run.arguments import CONFIG_FILE, LerobotArguments, read_config_file, whole_number

LEAST = {"steps": 1, "batch_size": 1, "num_workers": 0, "eval.batch_size": 0, "eval.n_episodes": 1}
"""Setting -> its smallest value."""


def check_numbers(arguments: LerobotArguments) -> None:
    """Refuse numbers, of the line or else of the configuration file, that are smaller than `LEAST`."""
    file = read_config_file(arguments.get(CONFIG_FILE))
    for key, least in LEAST.items():
        section, _, name = key.rpartition(".")
        held = file.get(section) if section else file
        text = arguments.get(key) or (str(held.get(name)) if isinstance(held, dict) else None)
        number = whole_number(text)
        if number is not None and number < least:
            raise MemobenchError(f"found {key}={number}; expected at least {least}")


def check_dataset(arguments: LerobotArguments) -> None:
    """Refuse a folder that is no dataset."""
    root = arguments.get("dataset.root")
    if root is None:
        return
    folder = Path(root).expanduser()
    local_only = (arguments.get("dataset.repo_id") or "").startswith("local/")
    if not folder.exists() and not local_only:
        return  # LeRobot downloads the repository into it
    if not folder.is_dir():
        raise MemobenchError(
            f"the dataset folder {root} does not exist; make one with `memobench generate --out {root}`"
        )
    if not (folder / INFO_FILE).is_file():
        raise MemobenchError(
            f"the folder {root} is not a LeRobot dataset ({INFO_FILE} is missing); make one with "
            "`memobench generate --out <folder>`"
        )
    read_info(folder)
    check_fetched(folder)


def check_memory_settings(arguments: LerobotArguments, policy: Any) -> None:
    """Refuse settings on the line that belong to another memory; errors as of `read_settings`."""
    given = yaml.safe_load(arguments.get("policy.memory_settings") or "{}")
    if given and getattr(policy, "memory", NONE) != NONE:
        read_settings(policy.memory, given)


def check_settings(config: TrainPipelineConfig) -> None:
    """Refuse settings of LeRobot's trainer that the loop of memory policies does not follow."""
    transformed = config.dataset.image_transforms.enable
    policy: Any = config.policy
    refused = [
        (config.dataset.streaming, "dataset.streaming=true", "memory needs all frames of an episode"),
        (config.sample_weighting is not None, "sample_weighting", "the loss weighs all samples alike"),
        (config.job.is_remote, "job.target", "the loop runs on this machine"),
        (
            transformed and policy.encodes_ahead,
            "dataset.image_transforms.enable=true",
            "this policy's pictures are encoded once, before training",
        ),
        # Of LeRobot's main branch.
        (getattr(getattr(config, "parallelism", None), "is_sharded", False), "parallelism.dp_shard", "no shards"),
        (getattr(getattr(config, "ema", None), "enable", False), "ema.enable=true", "see policy.ema_decay"),
    ]
    for present, setting, why in refused:
        if present:
            raise MemobenchError(f"{setting} has no effect on policy={policy.type} ({why}); leave it out")
    lacking = [
        (
            config.optimizer is None and not config.use_policy_training_preset,
            "optimizer.type=",
            "use_policy_training_preset=false",
        ),
        (config.eval_steps > 0 and config.dataset.eval_split == 0.0, "dataset.eval_split=0.1", "eval_steps="),
        (bool(policy.push_to_hub) and not policy.repo_id, "policy.repo_id=user/name", "policy.push_to_hub=true"),
        (
            config.save_checkpoint_to_hub and not policy.repo_id,
            "policy.repo_id=user/name",
            "save_checkpoint_to_hub=true",
        ),
        (
            bool(config.rename_map) and not policy.pretrained_path and not config.resume,
            "policy=<checkpoint>",
            "rename_map=",
        ),
    ]
    for absent, needed, setting in lacking:
        if absent:
            raise MemobenchError(f"{setting} needs {needed}; give it, or leave {setting.rstrip('=')} out")


def check_environment(config: TrainPipelineConfig, meta: Any, features: dict[str, Any]) -> None:
    """Refuse to evaluate on the benchmark, between updates, a policy that is trained on other cameras or sizes.

    Args:
        features: those of the dataset that it is trained on.
    """
    if config.policy is None or getattr(config.env, "type", None) != "memobench":
        return
    unseen = None if getattr(config.policy, "uses_pictures", True) else FeatureType.VISUAL
    known = dataset_to_policy_features(features)
    policy = copy.copy(config.policy)
    policy.output_features = {key: one for key, one in known.items() if one.type is FeatureType.ACTION}
    policy.input_features = policy.input_features or {
        key: one for key, one in known.items() if one.type not in (FeatureType.ACTION, unseen)
    }
    check_features(f"that learns from {meta.root}", policy, env_to_policy_features(config.env), config.rename_map)
