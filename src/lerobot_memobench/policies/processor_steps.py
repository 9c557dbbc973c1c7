"""Check the processor steps that a checkpoint names, before LeRobot builds them: it imports and calls any ``class``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError

PACKAGES = ("lerobot", "lerobot_memobench")
PLUGIN = "lerobot_policy_"
"""Prefix of the packages that LeRobot imports as plugins."""
NAMES_CODE = ("class", "registry_name", "_target_")
"""Keys of nested mappings that would build an object."""
REMOTE_CODE = {
    "action_tokenizer_name": "lerobot/fast-action-tokenizer",
    "paligemma_tokenizer_name": "google/paligemma-3b-pt-224",
    "model_name": "nvidia/Cosmos-Reason2-2B",
}
"""Settings of LeRobot's steps that run the Python code of a repository -> LeRobot's values."""


def check_step(file: Path, step: Mapping[str, Any], kind: str | None) -> None:
    """Refuse a saved step unless LeRobot, this package or an installed policy plugin registers it.

    Args:
        file: the processor's file. step: its entry there. kind: the checkpoint's type of policy.

    Raises:
        MemobenchError: the step is refused.
    """
    for reason in _reasons(step, kind):
        raise MemobenchError(
            f"{file} {reason}; expected steps with plain settings that LeRobot, this package or an installed {PLUGIN}* "
            "package registers: install the policy's package, or use a checkpoint that you trust"
        )


def _reasons(step: Mapping[str, Any], kind: str | None) -> Iterator[str]:
    """Yield the reasons to refuse a step."""
    name, config = step.get("registry_name"), step.get("config") or {}
    if not isinstance(name, str) or "class" in step:
        yield f"names the class {step.get('class')!r}, which LeRobot would import and call"
        return
    found = _registered(name, kind)
    if found is None or not _trusted(found.__module__.partition(".")[0]):
        yield f"names the step {name!r}, which {'no package' if found is None else found.__module__} registers"
    yield from (f"holds {key!r} in the settings of the step {name!r}, which would name code" for key in _naming(config))
    if config.get("trust_remote_code") is not False:
        for setting, known in REMOTE_CODE.items():
            if config.get(setting, known) != known:
                yield f"sets {setting}={config[setting]!r} in the step {name!r}, which runs code of that repository"


def _registered(name: str, kind: str | None) -> type | None:
    """Return the class of a registered step; None if no imported module registers it."""
    from lerobot.policies.factory import get_policy_class
    from lerobot.processor import ProcessorStepRegistry

    with suppress(Exception):  # packages of the policy may be missing
        get_policy_class(str(kind))
    with suppress(KeyError):
        return ProcessorStepRegistry.get(name)
    return None


def _trusted(package: str) -> bool:
    from lerobot.configs import PreTrainedConfig

    policies = {one.__module__.partition(".")[0] for one in PreTrainedConfig.get_known_choices().values()}
    return package in {*PACKAGES, *policies} or package.startswith(PLUGIN)


def _naming(value: Any) -> Iterator[str]:
    """Yield the keys, at any depth, that would name code."""
    if isinstance(value, Mapping):
        yield from (key for key in NAMES_CODE if key in value)
        value = list(value.values())
    for one in value if isinstance(value, list) else []:
        yield from _naming(one)
