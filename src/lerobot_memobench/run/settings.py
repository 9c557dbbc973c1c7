"""Settings of an evaluation of the benchmark, typed: read from words, a configuration file or a result card."""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Iterable, Mapping
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
from lerobot_memobench.policies.lerobot_config import quiet
from lerobot_memobench.run.arguments import (
    CHOICE_KEYS,
    CONFIG_FILE,
    Arguments,
    checked_value,
    chosen_class,
    for_parser,
    load_packages,
    read_config_file,
    register_plugins,
    translate,
    with_file,
)
from lerobot_memobench.run.arguments import settings as settings_of

EXPERT = "memobench_expert"
OWN = ("tasks", "task_dir", "log_dir", "resume")
"""Fields of `MemobenchEnvConfig` that are no settings of one environment."""
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
"""Keys of LeRobot's that change nothing in an evaluation of the benchmark."""


@dataclass(frozen=True)
class EvaluationSettings:
    """What is evaluated. None: the benchmark's default.

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

    def with_env(self, **settings: Any) -> EvaluationSettings:
        """Return settings with others of the environment."""
        return replace(self, env={**self.env, **settings})

    def env_default(self, name: str, value: Any) -> EvaluationSettings:
        """Return settings with one of the environment's where it was not named."""
        return self if name in self.env else self.with_env(**{name: value})

    @property
    def policy_path(self) -> str | None:
        """The checkpoint or repository of the policy, None for one that is not loaded."""
        return self.policy.get("path")

    @property
    def portable(self) -> dict[str, Any]:
        """The settings as JSON for the card: without the folders that are written, with the package's own policies by
        name and absolute paths of others.
        """
        found = {key: value for key, value in dataclasses.asdict(self).items() if key != "output_dir"}
        found["env"] = {key: value for key, value in found["env"].items() if key not in ("log_dir", "resume")}
        for section, name in (("policy", "path"), ("env", "task_dir")):
            if (named := found[section].get(name)) is not None and Path(named).expanduser().exists():
                portable = portable_path(named) if section == "policy" else named
                found[section][name] = str(Path(named).expanduser().absolute()) if portable == named else portable
        return found

    @property
    def words(self) -> list[str]:
        """The command line that says the same, with absolute paths, for a process of its own."""
        told = {**self.portable, "policy": {**self.portable["policy"]}}
        if self.policy_path is not None and Path(self.policy_path).expanduser().exists():
            told["policy"]["path"] = str(Path(self.policy_path).expanduser().absolute())
        flat = {f"env.{name}": value for name, value in told["env"].items()}
        flat |= {f"policy.{name}": value for name, value in told["policy"].items()}
        flat |= {key: told[name] for key, (name, _) in OTHERS.items() if told.get(name) not in (None, {})}
        return ["--env.type=memobench", *(f"--{key}={_text(value)}" for key, value in flat.items())]


def _text(value: Any) -> str:
    if value is None:
        return "null"
    return value if isinstance(value, str) else json.dumps(value)


def read_settings(given: Arguments) -> EvaluationSettings:
    """Return the settings that a command line, and the file that its ``config_path`` names, ask for.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    register_plugins()
    load_packages(given)
    file = read_config_file(given.value(CONFIG_FILE))
    given = with_file(given.without(CONFIG_FILE), file, EvalPipelineConfig)
    return settings_of_flags(translate("eval", given, EvalPipelineConfig, {}).flags)


def settings_of_flags(flags: Iterable[str]) -> EvaluationSettings:
    """Return the settings that LeRobot's flags, ``--key=value``, ask for.

    Raises:
        MemobenchError: one that an evaluation of the benchmark does not have.
    """
    env: dict[str, Any] = {}
    policy: dict[str, str] = {}
    others: dict[str, Any] = {}
    for flag in flags:
        key, equals, text = flag.removeprefix("--").partition("=")
        section, _, name = key.partition(".")
        if key in WITHOUT_EFFECT:
            continue
        if section == "env" and name in ENVIRONMENT:
            env[name] = _typed(key, ENVIRONMENT[name], text if equals else "true")
        elif section == "policy" and name:
            policy[name] = text if equals else "true"
        elif key in OTHERS:
            field_name, kind = OTHERS[key]
            others[field_name] = _typed(key, kind, text)
        else:
            known = [*OTHERS, *(f"env.{name}" for name in ENVIRONMENT)]
            raise MemobenchError(f"an evaluation of the benchmark has no setting {key!r}, {nearest(key, known)}")
    return EvaluationSettings(env, policy, **others)


def _typed(key: str, kind: Any, text: str) -> Any:
    """Return a value of its type, checked."""
    checked = checked_value(key, kind, text)
    if checked == "null" and kind is not str:
        return None
    named = [part for part in (typing.get_args(kind) or (kind,)) if part is not type(None)]
    if named == [str]:
        return checked
    return yaml.safe_load(checked) if typing.get_origin(kind) is dict else draccus.decode(named[0], checked)


# --- the configurations that LeRobot's code works with ---


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
    path, kind = asked.policy_path, asked.policy.get("type")
    known: dict[str, type] = PreTrainedConfig.get_known_choices()
    told = {key: text for key, text in asked.policy.items() if key not in CHOICE_KEYS}
    chosen = chosen_class(
        EvalPipelineConfig, "policy", [f"--policy.path={path}" if path else f"--policy.type={kind}"], {}
    )
    types = {} if chosen is None else dict(settings_of(chosen, {}))
    overrides = [for_parser(f"--{key}={text}", types) for key, text in told.items()]
    try:
        with quiet():
            if path is not None:
                return PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
            if kind in known:
                found: PreTrainedConfig = draccus.parse(known[kind], args=overrides)
                return found
    except yaml.YAMLError as error:  # LeRobot reads every value as YAML
        problem = " ".join(str(error).split())
        raise MemobenchError(f"a value of policy. cannot be read ({problem}); put it in quotes within quotes") from None
    raise MemobenchError(f"policy.type={kind} is not known; import the package that registers it")
