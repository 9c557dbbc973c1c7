"""Typed settings of an evaluation of the benchmark, from a command line, a configuration file or a result card."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import draccus
import yaml
from lerobot.configs import PreTrainedConfig
from lerobot.configs.eval import EvalPipelineConfig

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.checkpoint import portable_path
from lerobot_memobench.run.arguments import (
    CONFIG_FILE,
    Arguments,
    LerobotArguments,
    checked_value,
    chosen_class,
    load_plugins,
    read_config_file,
    translate,
    with_file,
    without_none,
)
from lerobot_memobench.tasks.catalogue import lerobots_choice
from lerobot_memobench.tasks.task import PUBLISHED

EXPERT = "memobench_expert"
OWN = ("task", "task_ids", "tasks", "task_dir", "log_dir", "resume")
"""Fields of `MemobenchEnvConfig` that do not belong to `EnvSettings`."""
ENVIRONMENT: dict[str, Any] = {
    name: kind
    for name, kind in typing.get_type_hints(MemobenchEnvConfig).items()
    if name in (*OWN, *(each.name for each in fields(EnvSettings)))
}
"""Setting of the environment -> its type."""
OTHERS: dict[str, tuple[str, Any]] = {
    "seed": ("seed", int),
    "eval.n_episodes": ("episodes", int),
    "eval.batch_size": ("batch_size", int),
    "eval.use_async_envs": ("use_async_envs", bool),
    "rename_map": ("rename_map", dict[str, str]),
    "output_dir": ("output_dir", str),
}
"""LeRobot's key -> field of `EvaluationSettings`, and its type."""
WITHOUT_EFFECT = ("env.type", "env.discover_packages_path", "job_name", "trust_remote_code")
"""LeRobot's keys without an effect on an evaluation of the benchmark."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation. None: the benchmark's default.

    Attributes:
        env: fields of `MemobenchEnvConfig` by name.
        policy: ``path`` of a checkpoint or ``type``, and settings of the policy's configuration as text.
        seed: of the first episode of each task.
        episodes: of each task.
        batch_size: environments at once. use_async_envs: whether each has a process of its own.
        rename_map: LeRobot's: names of the environment's observations -> names of the policy's.
        output_dir: folder of the evaluation; not part of the card.
    """

    env: Mapping[str, Any] = field(default_factory=dict)
    policy: Mapping[str, str] = field(default_factory=dict)
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
        """The settings as JSON for the card.

        They leave out the folders that are written. The package's own policies go by name, other paths are absolute.
        """
        found = {key: value for key, value in dataclasses.asdict(self).items() if key != "output_dir"}
        found["env"] = {key: value for key, value in found["env"].items() if key not in ("log_dir", "resume")}
        for section, name in (("policy", "path"), ("env", "task_dir")):
            if (named := found[section].get(name)) is not None and Path(named).expanduser().exists():
                portable = portable_path(named) if section == "policy" else named
                found[section][name] = str(Path(named).expanduser().absolute()) if portable == named else portable
        return found


def read_settings(given: Arguments) -> EvaluationSettings:
    """Return the settings that a command line, and the file that its ``config_path`` names, ask for.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    load_plugins(given)
    file = read_config_file(given.value(CONFIG_FILE))
    given = with_file(given.without(CONFIG_FILE), file, EvalPipelineConfig)
    return typed_settings(translate("eval", given, EvalPipelineConfig, {}).values)


def typed_settings(values: Mapping[str, str | None]) -> EvaluationSettings:
    """Return the settings for LeRobot's keys and values; None means a flag without a value.

    Raises:
        MemobenchError: an evaluation of the benchmark has no such setting, or a value has another type.
    """
    env: dict[str, Any] = {}
    policy: dict[str, str] = {}
    others: dict[str, Any] = {}
    for key, given in values.items():
        text = "true" if given is None else given
        section, _, name = key.partition(".")
        if section == "env" and name in ENVIRONMENT:
            env[name] = _typed(key, ENVIRONMENT[name], text)
        elif section == "policy" and name:
            policy[name] = text
        elif key in OTHERS:
            field_name, kind = OTHERS[key]
            others[field_name] = _typed(key, kind, text)
        elif key not in WITHOUT_EFFECT:
            known = [*OTHERS, *(f"env.{name}" for name in ENVIRONMENT)]
            raise MemobenchError(f"an evaluation of the benchmark has no setting {key!r}, {nearest(key, known)}")
    return EvaluationSettings(_without_lerobots_names(env), policy, **others)


def _without_lerobots_names(env: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with ``suite`` and ``tasks`` instead of LeRobot's ``task`` and ``task_ids``.

    Raises:
        MemobenchError: they contradict each other, or name several suites.
    """
    names = ("task", "task_ids")
    if not {*names} & {*env}:
        return {**env}
    task, ids = (env.get(name) for name in names)
    suites, tasks = lerobots_choice(task, ids, env.get("suite", PUBLISHED), env.get("tasks", "all"))
    if len(suites) > 1:
        raise MemobenchError(f"task={task} names {len(suites)} suites; an evaluation is of one: run each by itself")
    return {name: value for name, value in env.items() if name not in names} | {"suite": suites[0], "tasks": tasks}


def _typed(key: str, kind: Any, text: str) -> Any:
    """Return a value of its type, checked."""
    checked = checked_value(key, kind, text)
    if checked == "null" and kind is not str:
        return None
    named = [part for part in (typing.get_args(kind) or (kind,)) if part is not type(None)]
    if named == [str]:
        return checked
    if typing.get_origin(without_none(kind)) in (dict, list):
        return yaml.safe_load(checked)
    return draccus.decode(named[0], checked)


def with_policy(asked: EvaluationSettings) -> EvaluationSettings:
    """Return settings that evaluate the scripted expert where no policy is named."""
    if {"type", "path"} & asked.policy.keys():
        return asked
    return replace(asked, policy={**asked.policy, "type": EXPERT})


def policy_of(asked: EvaluationSettings) -> PreTrainedConfig:
    """Return the configuration of the policy; that of a repository is downloaded.

    Raises:
        MemobenchError: the type is not known, or a value cannot be read. Others are the configuration's own.
    """
    values = {f"policy.{name}": text for name, text in asked.policy.items()}
    # The type of a repository that is not here yet is known once LeRobot has fetched it.
    chosen = chosen_class(EvalPipelineConfig, "policy", values, {}) or PreTrainedConfig
    found: PreTrainedConfig = LerobotArguments(values, EvalPipelineConfig, {"policy": chosen}).configuration("policy")
    return found
