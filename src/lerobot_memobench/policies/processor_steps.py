"""Check the processor steps that a checkpoint names, before LeRobot builds them.

LeRobot imports and calls whatever a step's ``class`` names. A checkpoint may come from a stranger, so it may name
registered steps of installed packages only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError

PACKAGES = ("lerobot", "lerobot_memobench")
PLUGIN = "lerobot_policy_"
"""First part of the name of every package that LeRobot imports as a plugin."""
NAMES_CODE = ("class", "registry_name", "_target_")
"""Keys by which a nested mapping would ask for an object to be built."""
REMOTE_CODE = {
    "action_tokenizer_processor": {
        "action_tokenizer_name": "lerobot/fast-action-tokenizer",
        "paligemma_tokenizer_name": "google/paligemma-3b-pt-224",
    },
    "groot_n1_7_vlm_encode_v1": {"model_name": "nvidia/Cosmos-Reason2-2B"},
}
"""Steps of LeRobot that run Python code of a repository -> their settings that name it, and LeRobot's own values."""


def check_step(file: Path, step: Mapping[str, Any], kind: str | None) -> None:
    """Refuse a saved step unless LeRobot, this package or an installed policy plugin registers it.

    Args:
        file: the processor's file. step: its entry there. kind: the checkpoint's type of policy, whose module is
            imported where no step of that name is registered yet.

    Raises:
        MemobenchError: the step is refused.
    """
    name, config = step.get("registry_name"), step.get("config") or {}
    if not isinstance(name, str) or "class" in step:
        raise MemobenchError(
            f"{file} names the class {step.get('class')!r}, which LeRobot would import and call; expected a step's "
            "registry_name: use a checkpoint of a source that you trust, saved by lerobot-train"
        )
    found = _registered(name, kind)
    if found is None or not _trusted(found.__module__.partition(".")[0]):
        holder = "no package" if found is None else found.__module__
        raise MemobenchError(
            f"{file} names the step {name!r}, which {holder} registers; expected a step of LeRobot, of this package or "
            f"of an installed {PLUGIN}* package: install the package that this policy comes with"
        )
    key = next(_naming(config), None)
    if key is not None:
        raise MemobenchError(
            f"{file} holds {key!r} in the settings of the step {name!r}, which would name code; expected plain values: "
            "use a checkpoint of a source that you trust"
        )
    if config.get("trust_remote_code") is not False:
        for setting, known in REMOTE_CODE.get(name, {}).items():
            if config.get(setting, known) != known:
                raise MemobenchError(
                    f"{file} sets {setting}={config[setting]!r} in the step {name!r}, which runs the code of that "
                    f"repository; expected {known}: write it there, or use another checkpoint"
                )


def _registered(name: str, kind: str | None) -> type | None:
    """Return the class of a registered step; None where there is none."""
    from lerobot.policies.factory import get_policy_class
    from lerobot.processor import ProcessorStepRegistry

    for imports in (lambda: None, lambda: get_policy_class(str(kind))):
        with suppress(Exception):  # an unknown name, or a policy whose packages are not installed
            imports()
            return ProcessorStepRegistry.get(name)
    return None


def _trusted(package: str) -> bool:
    from lerobot.configs import PreTrainedConfig

    policies = {one.__module__.partition(".")[0] for one in PreTrainedConfig.get_known_choices().values()}
    return package in PACKAGES or package.startswith(PLUGIN) or package in policies


def _naming(value: Any) -> Iterator[str]:
    """Yield the keys, at any depth, that would name code."""
    if isinstance(value, Mapping):
        yield from (key for key in NAMES_CODE if key in value)
        value = value.values()
    elif not isinstance(value, list):
        return
    for one in value:
        yield from _naming(one)
