"""Read and check LeRobot's configuration of a training."""

from __future__ import annotations

import copy
import datetime as dt
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from lerobot.common.train_utils import resolve_resume_checkpoint
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_memobench.envs.settings import OBJECTS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.compatibility import check_features, trained_convention
from lerobot_memobench.run.command_line import CommandSettings
from lerobot_memobench.sim.convention import convention_of

READ = frozenset(
    {
        *("batch_size", "checkpoint_path", "cudnn_deterministic", "dataloader_multiprocessing_context", "dataset"),
        *("env", "env_eval_freq", "eval", "eval_steps", "job_name", "log_freq", "max_eval_samples", "num_workers"),
        *("optimizer", "output_dir", "peft", "persistent_workers", "policy", "prefetch_factor", "rename_map", "resume"),
        *("save_checkpoint", "save_checkpoint_to_hub", "save_freq", "scheduler", "seed", "steps", "tolerance_s"),
        *("use_policy_training_preset", "wandb"),
    }
)
"""Fields of LeRobot's configuration that the loop of memory policies reads, itself or through LeRobot's functions."""


def complete(config: TrainPipelineConfig, asked: CommandSettings) -> TrainPipelineConfig:
    """Return the configuration of a memory policy's training with its optimizer, folder of the run and checkpoint.

    Raises:
        MemobenchError: settings do not go together.
    """
    policy, now = config.policy, dt.datetime.now()
    assert policy is not None
    check_settings(config)
    if config.resume:
        file = asked.config_path
        assert file is not None
        if Path(file).exists():
            pretrained = Path(file) if Path(file).is_dir() else Path(file).parent
        else:  # a repository
            named = asked.words.get("output_dir") or f"outputs/train/{now:%Y-%m-%d/%H-%M-%S}"
            config.output_dir = Path(named)
            pretrained = resolve_resume_checkpoint(file, config.output_dir) / "pretrained_model"
        config.checkpoint_path, policy.pretrained_path = pretrained.parent, pretrained
    elif config.output_dir is not None and config.output_dir.is_dir():
        raise MemobenchError(
            f"the folder output_dir={config.output_dir} exists already; name another one, or resume its training with "
            "resume=true"
        )
    config.job_name = config.job_name or "_".join(one.type for one in (config.env, policy) if one is not None)
    config.output_dir = config.output_dir or Path(f"outputs/train/{now:%Y-%m-%d/%H-%M-%S}_{config.job_name}")
    if config.use_policy_training_preset and not config.resume:
        config.optimizer, config.scheduler = policy.get_optimizer_preset(), policy.get_scheduler_preset()
    return config


def check_settings(config: TrainPipelineConfig) -> None:
    """Refuse settings of LeRobot's trainer that the loop of memory policies does not support, or does not read."""
    policy: Any = config.policy
    unused = TrainPipelineConfig(config.dataset)
    for name, value in vars(config).items():
        for setting, found in () if name in READ else changes(name, value, getattr(unused, name, None)):
            raise MemobenchError(f"{setting}={found} has no effect on policy={policy.type}; leave it out")
    encodes_ahead = policy.uses_detector or policy.uses_visual_encoder
    encoded = config.dataset.image_transforms.enable and encodes_ahead
    no_optimizer = config.optimizer is None and not config.use_policy_training_preset
    new_policy = not policy.pretrained_path and not config.resume
    repository = policy.repo_id
    refused = [
        (config.dataset.streaming, "dataset.streaming=true", "memory needs all frames of an episode"),
        (policy.use_amp, "policy.use_amp=true", "policy.dtype sets the precision"),
        (config.eval.recording, "eval.recording=true", "rollouts of a training are not recorded"),
        (encoded, "dataset.image_transforms.enable=true", "images are encoded once, before training"),
    ]
    for present, setting, why in refused:
        if present:
            raise MemobenchError(f"{setting} has no effect on policy={policy.type} ({why}); leave it out")
    lacking = [
        (no_optimizer, "optimizer.type=", "use_policy_training_preset=false"),
        (config.eval_steps > 0 and config.dataset.eval_split == 0.0, "dataset.eval_split=0.1", "eval_steps="),
        (policy.push_to_hub and not repository, "policy.repo_id=user/name", "policy.push_to_hub=true"),
        (config.save_checkpoint_to_hub and not repository, "policy.repo_id=user/name", "save_checkpoint_to_hub=true"),
        (config.rename_map and new_policy, "policy=<checkpoint>", "rename_map="),
    ]
    for absent, needed, setting in lacking:
        if absent:
            raise MemobenchError(f"{setting} needs {needed}; give it, or leave {setting.rstrip('=')} out")


def changes(name: str, value: object, default: object) -> Iterator[tuple[str, object]]:
    """Yield name and value of the settings of a field that differ from its default."""
    if is_dataclass(value) and is_dataclass(default):
        for one in fields(value):
            yield from changes(f"{name}.{one.name}", getattr(value, one.name), getattr(default, one.name, None))
    elif value != default:
        yield name, value


def with_features(policy: Any, features: dict[str, Any]) -> Any:
    """Return a policy's configuration with a dataset's features, as LeRobot sets them; given inputs stay."""
    unused = None if getattr(policy, "uses_pictures", True) else FeatureType.VISUAL
    known = dataset_to_policy_features(features)
    made = copy.copy(policy)
    made.output_features = {key: one for key, one in known.items() if one.type is FeatureType.ACTION}
    made.input_features = dict(policy.input_features or {}) or {
        key: one for key, one in known.items() if one.type not in (FeatureType.ACTION, unused)
    }
    return made


def check_convention(config: TrainPipelineConfig, meta: Any, features: dict[str, Any]) -> None:
    """Refuse to continue a checkpoint's training on pictures of another convention.

    Args:
        features: of the dataset.
    """
    policy, stated = config.policy, convention_of(features)
    if policy is None or policy.pretrained_path is None or config.resume or stated is None or not policy.image_features:
        return
    found, why = trained_convention(str(policy.pretrained_path), policy)
    if found not in (None, stated):
        raise MemobenchError(
            f"the policy {policy.pretrained_path} was trained on pictures of convention={found} ({why}), and "
            f"{meta.root} has convention={stated}; mirror them: `memobench view {meta.root} --convention {found} --out "
            "<folder>`"
        )


def check_environment(config: TrainPipelineConfig, meta: Any, features: dict[str, Any]) -> None:
    """Refuse evaluations on the benchmark during a training on other cameras, sizes or conventions of pictures.

    The environment receives the plans of the policy, on which holds depend.

    Args:
        features: of the dataset.
    """
    check_convention(config, meta, features)
    if config.policy is None or getattr(config.env, "type", None) != "memobench":
        return
    env: Any = config.env
    if (stated := convention_of(features)) not in (None, env.convention) and env.obs_type != OBJECTS:
        raise MemobenchError(f"{meta.root} has pictures of convention={stated}; set env.convention={stated}")
    if config.policy.type == "xvla":
        raise MemobenchError(
            "LeRobot's trainer evaluates every XVLA with the processors of LIBERO; leave env out, and evaluate its "
            "checkpoints with `lerobot eval env=memobench`"
        )
    env.declare_plans(config.policy)
    policy = with_features(config.policy, features)
    check_features(f"that learns from {meta.root}", policy, env_to_policy_features(config.env), config.rename_map)
