"""Where does the prompt play: in steps that the policy sees, or within `reset`? It depends on what the policy knows.

A policy that knows phases declares it on the class of its configuration, ``knows_phases: ClassVar[bool] = True``: it
waits while `observation.phase` is 0, and plans anew when it becomes 1. Any other policy would act on a recording, and
its queue would still hold those actions when the scene is restored. To it an episode begins at its first execution
frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

AUTO, STEPS, RESET = "auto", "steps", "reset"
PLACES = (AUTO, STEPS, RESET)
"""Values of ``env.prompt_in``."""


def knows_phases(policy: object) -> bool:
    """Return whether a policy's configuration, or its class, declares that it knows phases."""
    return bool(getattr(policy, "knows_phases", False))


def prompt_in(policy: object | None) -> str:
    """Return `STEPS` or `RESET`, as suits a policy's configuration or its class; `STEPS` where none is known."""
    return STEPS if policy is None or knows_phases(policy) else RESET


def policy_being_run() -> type | None:
    """Return the class of the configuration of the policy on LeRobot's command line, None where none is told.

    An environment's configuration does not hold the policy; LeRobot's parser tells it.
    """
    from lerobot.configs import PreTrainedConfig, parser

    path = parser.get_path_arg("policy")
    if path is not None:
        overrides = [*parser.get_yaml_overrides("policy"), *(parser.get_cli_overrides("policy") or [])]
        return type(PreTrainedConfig.from_pretrained(path, cli_overrides=overrides))
    name = parser.get_type_arg("policy") or _type_in_file(parser.parse_arg("config_path"))
    known: dict[str, type] = PreTrainedConfig.get_known_choices()
    return known.get(name) if name is not None else None


def parameters_being_run() -> int | None:
    """Return about how many parameters the policy on LeRobot's command line has, None where that is not known yet."""
    from lerobot.configs import parser

    path = parser.get_path_arg("policy")
    if path is None:
        return 0 if getattr(policy_being_run(), "weightless", False) else None
    return parameters_of(path)


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


def _type_in_file(path: str | None) -> str | None:
    """Return the policy type in a local file of LeRobot's settings, or in a checkpoint's folder; None without one."""
    if path is None:
        return None
    file = Path(path) / "train_config.json" if Path(path).is_dir() else Path(path)
    try:
        name: Any = yaml.safe_load(file.read_text())["policy"]["type"]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return None
    return name if isinstance(name, str) else None
