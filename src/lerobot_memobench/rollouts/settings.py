"""Typed settings of an evaluation of the benchmark, from a command line, a configuration file or a result card."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.configs.eval import EvalPipelineConfig

from lerobot_memobench.commands.command_line import (
    TYPE,
    build_config,
    chosen_class,
    field_types,
    given_values,
    read_words,
    value_of,
)
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.settings import SETTINGS, EnvSettings
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.checkpoint import portable_path
from lerobot_memobench.tasks.catalogue import lerobots_choice
from lerobot_memobench.tasks.task import PUBLISHED

EXPERT = "memobench_expert"
OWN = ("task", "task_ids", "tasks", "task_dir", "log_dir", "resume")
"""Fields of `MemobenchEnvConfig` that do not belong to `EnvSettings`."""
ENVIRONMENT: dict[str, Any] = {
    name: kind
    for name, kind in typing.get_type_hints(MemobenchEnvConfig).items()
    if name in (*OWN, *(setting.name for setting in fields(EnvSettings)))
}
"""Setting of the environment -> its type."""
OTHERS = {
    **{name: name for name in ("seed", "rename_map", "output_dir")},
    **{"eval.n_episodes": "episodes", "eval.batch_size": "batch_size", "eval.use_async_envs": "use_async_envs"},
}
"""LeRobot's key -> field of `EvaluationSettings`."""
WITHOUT_EFFECT = (f"env.{TYPE}", "job_name", "trust_remote_code")
"""LeRobot's keys without an effect on an evaluation of the benchmark."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation. None: the benchmark's default.

    Attributes:
        env: fields of `MemobenchEnvConfig` by name.
        policy: ``path`` of a checkpoint or ``type``, and settings of the policy's configuration.
        seed: of the first episode of each task.
        episodes: of each task.
        batch_size: environments at once. use_async_envs: whether each has a process of its own.
        rename_map: LeRobot's: names of the environment's observations -> names of the policy's.
        output_dir: folder of the evaluation; not part of the card.
    """

    env: Mapping[str, Any] = field(default_factory=dict)
    policy: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    episodes: int | None = None
    batch_size: int | None = None
    use_async_envs: bool | None = None
    rename_map: Mapping[str, str] = field(default_factory=dict)
    output_dir: str | None = None

    def env_default(self, **settings: Any) -> EvaluationSettings:
        """Return settings with defaults of the environment."""
        return replace(self, env={**settings, **self.env})

    @property
    def policy_path(self) -> str | None:
        """The checkpoint or repository of the policy, None for a policy without weights."""
        return self.policy.get("path")

    @property
    def portable(self) -> dict[str, Any]:
        """The settings for the card, as far as its protocol does not hold them; `card_settings` reads them back.

        They leave out the folders that are written. The package's own policies go by name, other paths are absolute.
        """
        left_out = (*SETTINGS, "log_dir", "resume")
        env = {name: value for name, value in self.env.items() if name not in left_out}
        policy = dict(self.policy)
        for section, name in ((policy, "path"), (env, "task_dir")):
            if (path := section.get(name)) is not None and Path(path).expanduser().exists():
                portable = portable_path(path) if section is policy else path
                section[name] = str(Path(path).expanduser().absolute()) if portable == path else portable
        loop = {name: getattr(self, name) for name in ("batch_size", "use_async_envs")}
        return {"env": env, "policy": policy, **loop, "rename_map": dict(self.rename_map)}


def card_settings(card: Mapping[str, Any]) -> EvaluationSettings:
    """Return the settings of a card, see `EvaluationSettings.portable`; their values are not checked."""
    protocol, stored = card["protocol"], card["settings"]
    env = {name: protocol[name] for name in SETTINGS if name in protocol} | stored.get("env", {})
    own = {"env": env, "seed": card["policy"].get("seed"), "episodes": protocol["episodes"]}
    return EvaluationSettings(**stored | own)


def read_settings(words: Mapping[str, str]) -> EvaluationSettings:
    """Return the settings that a command line, and the file that its ``config_path`` names, ask for.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    settings = typed_settings(read_words("eval", words).settings)
    chosen = chosen_class(PreTrainedConfig, "policy", with_policy(settings).policy)
    return replace(settings, policy={**settings.policy, **given_values(chosen, settings.policy, "policy.")})


def typed_settings(nested: Mapping[str, Any]) -> EvaluationSettings:
    """Return settings for LeRobot's names, nested; raise for unknown names, and values of another type."""
    known = field_types(EvalPipelineConfig)
    env, policy, loop = (_section(name, nested.get(name)) for name in ("env", "policy", "eval"))
    top_level = {name: value for name, value in nested.items() if name not in ("env", "policy", "eval")}
    kinds = {**known, **{f"eval.{name}": kind for name, kind in field_types(known["eval"]).items()}}
    loop_fields: dict[str, Any] = {}
    for key, value in {**top_level, **{f"eval.{name}": value for name, value in loop.items()}}.items():
        if key in OTHERS:
            loop_fields[OTHERS[key]] = value_of(key, kinds[key], value)
        elif key not in WITHOUT_EFFECT:
            raise _without_setting(key)
    for name in env:
        if name not in ENVIRONMENT and f"env.{name}" not in WITHOUT_EFFECT:
            raise _without_setting(f"env.{name}")
    typed = {name: value_of(f"env.{name}", ENVIRONMENT[name], env[name]) for name in env if name in ENVIRONMENT}
    return EvaluationSettings(_without_lerobots_names(typed), policy, **loop_fields)


def _section(name: str, section: Any) -> dict[str, Any]:
    if not isinstance(section, Mapping | None):
        raise MemobenchError(f"found {name}={section}; expected settings, such as {name}.<name>=")
    return {**(section or {})}


def _without_setting(key: str) -> MemobenchError:
    known = [*OTHERS, *(f"env.{name}" for name in ENVIRONMENT)]
    return MemobenchError(f"an evaluation of the benchmark has no setting {key!r}, {nearest(key, known)}")


def _without_lerobots_names(env: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with ``suite`` and ``tasks`` instead of LeRobot's ``task`` and ``task_ids``, of one suite."""
    names = ("task", "task_ids")
    if not {*names} & {*env}:
        return {**env}
    task, ids = (env.get(name) for name in names)
    suites, tasks = lerobots_choice(task, ids, env.get("suite", PUBLISHED), env.get("tasks", "all"))
    if len(suites) > 1:
        raise MemobenchError(f"task={task} names {len(suites)} suites; an evaluation is of one: run each by itself")
    return {name: value for name, value in env.items() if name not in names} | {"suite": suites[0], "tasks": tasks}


def with_policy(settings: EvaluationSettings) -> EvaluationSettings:
    """Return settings that evaluate the scripted expert where no policy is named."""
    if {"type", "path"} & settings.policy.keys():
        return settings
    return replace(settings, policy={**settings.policy, "type": EXPERT})


def policy_of(settings: EvaluationSettings) -> PreTrainedConfig:
    """Return the configuration of the policy; that of a repository is downloaded.

    Raises:
        MemobenchError: the type is not known, or a value cannot be read. Others are the configuration's own.
    """
    config: PreTrainedConfig = build_config(PreTrainedConfig, settings.policy, "policy")
    config.pretrained_path = None  # it does not depend on the place of the checkpoint
    return config
