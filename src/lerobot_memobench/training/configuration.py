"""Read LeRobot's configuration of a training from flags, as LeRobot's trainer reads it from ``sys.argv``."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from pathlib import Path

import draccus
from lerobot.common.train_utils import resolve_resume_checkpoint
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.train import TrainPipelineConfig

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.lerobot_config import overrides
from lerobot_memobench.training.checks import check_settings

CHOICES = ["policy", "reward_model"]
"""Fields of which LeRobot's parser takes a ``path``."""


def read_config(flags: Sequence[str]) -> TrainPipelineConfig:
    """Return the configuration as it is typed, with the policy's of the checkpoint that it names."""
    for key, package in parser.parse_plugin_args("discover_packages_path", flags).items():
        parser.load_plugin(package)
        flags = parser.filter_arg(key, flags)
    file, rest = parser.parse_arg("config_path", flags), parser.filter_path_args(CHOICES, flags)
    config: TrainPipelineConfig
    if file is None:
        config = draccus.parse(TrainPipelineConfig, args=rest)
    else:
        named = parser.extract_path_fields_from_config(file, CHOICES)
        config = TrainPipelineConfig.from_pretrained(named, cli_args=parser.filter_arg("config_path", rest))
    path = parser.get_path_arg("policy", flags)
    if path is not None:
        told = [*parser.get_yaml_overrides("policy"), *overrides("policy", flags)]
        config.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=told)
        config.policy.pretrained_path = Path(path)
    return config


def read_training(flags: Sequence[str]) -> TrainPipelineConfig:
    """Return the complete configuration of a memory policy's training: optimizer, folder of the run, checkpoint.

    Raises:
        MemobenchError: settings do not go together.
    """
    config, now = read_config(flags), dt.datetime.now()
    policy = config.policy
    assert policy is not None
    check_settings(config)
    if config.resume:
        file = parser.parse_arg("config_path", flags)
        assert file is not None
        if Path(file).exists():
            pretrained = Path(file) if Path(file).is_dir() else Path(file).parent
        else:  # a repository
            config.output_dir = Path(parser.parse_arg("output_dir", flags) or f"outputs/train/{now:%Y-%m-%d/%H-%M-%S}")
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
