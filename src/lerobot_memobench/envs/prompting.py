"""Where does the demonstration prompt play: in steps that the policy observes, or within `reset`?

A policy that reads prompts declares it on the class of its configuration, ``reads_prompt: ClassVar[bool] = True``: it
waits while `observation.phase` is 0, and plans anew when it becomes 1. Any other policy would act on a recording, and
its queue would still hold those actions when the scene is restored. To it an episode begins at its first execution
frame.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from lerobot.configs import PreTrainedConfig

AUTO, STEPS, RESET = "auto", "steps", "reset"
PLACES = (AUTO, STEPS, RESET)
"""Values of ``env.prompt_in``."""


def reads_prompt(policy: object) -> bool:
    """Return whether a policy's configuration, or its class, declares that it reads prompts."""
    return bool(getattr(policy, "reads_prompt", False))


def prompt_in(policy: object | None) -> str:
    """Return `STEPS` or `RESET`, as suits a policy's configuration or its class; `STEPS` where none is known."""
    return STEPS if policy is None or reads_prompt(policy) else RESET


def policy_being_run() -> PreTrainedConfig | type | None:
    """Return the configuration of the policy on LeRobot's command line; where only its type is told, in a file, the
    class of it; None where none is told.

    An environment's configuration does not hold the policy; LeRobot's parser tells it.
    """
    import draccus
    from lerobot.configs import PreTrainedConfig, parser

    path, name = parser.get_path_arg("policy"), parser.get_type_arg("policy")
    told = parser.get_cli_overrides("policy") or []
    with quiet():
        if path is not None:
            overrides = [*parser.get_yaml_overrides("policy"), *told]
            return PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
        known: dict[str, type] = PreTrainedConfig.get_known_choices()
        kind = known.get(str(name or in_file("policy", "type")))
        return kind if kind is None or name is None else draccus.parse(kind, args=told)


def parameters_of(path: str) -> int | None:
    """Return about how many parameters a checkpoint's policy has, by the size of its weights, four bytes each.

    Args:
        path: its folder, or a repository. None is returned for one that is not on this machine.
    """
    from huggingface_hub import try_to_load_from_cache

    folder = Path(path).expanduser()
    if not folder.is_dir():
        cached = try_to_load_from_cache(path, "config.json")
        if not isinstance(cached, str):
            return None
        folder = Path(cached).parent
    sizes = [file.stat().st_size for file in folder.glob("*model*.safetensors")]
    return sum(sizes) // 4 if sizes else None


@contextmanager
def quiet() -> Iterator[None]:
    """Keep LeRobot's log lines about plugins and configurations to the run itself, which reads them again."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)


def training_runs() -> bool:
    """Return whether a dataset is on LeRobot's command line: then a policy is trained on it, whatever it saw before."""
    return any(argument.startswith("--dataset.") for argument in sys.argv[1:]) or in_file("dataset") is not None


def rename_map() -> dict[str, str]:
    """Return LeRobot's ``rename_map`` of its command line: names of the environment's -> names of the policy's."""
    from lerobot.configs import parser

    return read_rename_map(parser.parse_arg("rename_map") or in_file("rename_map"))


def name_in_data(name: str) -> str:
    """Return what the dataset or the environment of LeRobot's command line calls a policy's observation."""
    return {known: given for given, known in rename_map().items()}.get(name, name)


def read_rename_map(told: Any) -> dict[str, str]:
    """Return a ``rename_map`` as it is told, as text perhaps; nothing where it is none, which LeRobot says itself."""
    try:
        found = yaml.safe_load(told) if isinstance(told, str) else told
    except yaml.YAMLError:
        return {}
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else {}


def in_file(*keys: str) -> Any | None:
    """Return what a local file of LeRobot's settings, or the one in a checkpoint's folder, says; None without one."""
    from lerobot.configs import parser

    path = parser.parse_arg("config_path")
    if path is None:
        return None
    file = Path(path) / "train_config.json" if Path(path).is_dir() else Path(path)
    try:
        found: Any = yaml.safe_load(file.read_text())
        for key in keys:
            found = found[key]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return None
    return found
