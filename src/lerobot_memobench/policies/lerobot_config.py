"""Configurations of LeRobot's policies: plain values, and a hash that identifies what acts."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.evaluation_file import Acting
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash
from lerobot_memobench.policies.checkpoint import cached_folder

NOT_THE_CHECKPOINT = (
    *("train_config.json", "README.md", "training_weights.safetensors", ".gitattributes"),
    *("training_curve.png", "training_curve.json"),
)
"""Files of a checkpoint folder that do not affect the policy's actions."""

ELSEWHERE = (
    *("device", "pretrained_path", "repo_id", "private", "tags", "license", "push_to_hub", "use_peft"),
    *("host", "port", "servers", "connect_timeout", "timeout"),
)
"""Settings of where a policy runs or is published; its actions do not depend on them."""

LONGEST, LARGEST = 100_000, 10_000_000
"""Largest number of control steps or tokens of a policy, and largest other number of its configuration."""
LENGTHS = ("chunk_size", "horizon", "memory_settings.frames", "n_action_steps", "n_obs_steps", "tokenizer_max_length")


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress LeRobot's log lines about plugins and configurations; the run logs them again."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)


def encoded_config(policy: Any) -> dict[str, Any]:
    """Return a policy's configuration as plain JSON values."""
    import draccus

    values = json.loads(json.dumps(draccus.encode(policy), default=str))
    assert isinstance(values, dict)
    return {**values, "type": policy.type}


def check_sizes(policy: Any) -> None:
    """Refuse a policy whose configuration has a length or a size that no machine can allocate."""
    for name, value in _integers(encoded_config(policy)):
        most = LONGEST if name in LENGTHS else None if name.startswith("scheduler_") or "seed" in name else LARGEST
        if most is not None and value > most:
            raise MemobenchError(f"found policy.{name}={value}; expected at most {most}")


def _integers(value: Any, name: str = "") -> Iterator[tuple[str, int]]:
    """Yield dotted name and value of the whole numbers in an encoded configuration."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _integers(item, f"{name}.{key}".lstrip("."))
    elif isinstance(value, int):
        yield name, value


def has_device(device: str) -> bool:
    """Return whether this machine has a device of torch, such as ``cuda:1``."""
    import torch
    from lerobot.utils.device_utils import is_torch_device_available

    try:
        torch_device = torch.device(device)
        available = is_torch_device_available(torch_device.type)
    except (RuntimeError, ValueError):  # there is no such type
        return False
    return available and (torch_device.type != "cuda" or (torch_device.index or 0) < torch.cuda.device_count())


def check_device(device: str | None) -> None:
    """Refuse a device that the user names and the machine lacks. LeRobot would run on another one."""
    if device is not None and device not in ("", "null", "~") and not has_device(device):
        raise MemobenchError(
            f"this machine has no device {device!r} that torch can use; leave the device out to use the best one, or "
            "name cpu"
        )


# --- identity ---


def acting(policy: Any, path: str | None, settings: EnvSettings) -> Acting:
    """Return the description of a policy (its configuration, and its checkpoint or None) for the evaluation's file."""
    inputs = policy_inputs(policy, settings.obs_type, settings.oracle_memory)
    weights = None if path is None else checkpoint_hash(path)
    hashed = {"sha256": weights} if path is not None and Path(path).is_dir() else {}
    return Acting({"type": policy.type, "identity": identity_of(policy, path, weights), **hashed}, inputs)


def identity_of(policy: Any, path: str | None, weights: str | None) -> str:
    """Return a policy's type and one hash over its checkpoint's hash and the settings that differ from it."""
    with quiet():
        before = encoded_config(_default_config(policy, path))
    changes = {
        key: file_hash(Path(value)) if isinstance(value, str) and Path(value).is_file() else value
        for key, value in encoded_config(policy).items()
        if key not in (*ELSEWHERE, "type") and before.get(key) != value
    }
    facts = json.dumps([policy.type, weights, changes], sort_keys=True, default=str)
    return f"{policy.type} {hashlib.sha256(facts.encode()).hexdigest()[:12]}"


def _default_config(policy: Any, path: str | None) -> Any:
    from lerobot.configs import PreTrainedConfig

    if path is not None:
        return PreTrainedConfig.from_pretrained(path)
    try:
        return type(policy)()
    except TypeError:  # a plugin with a required setting
        return policy


def checkpoint_hash(path: str) -> str:
    """Return one hash for a checkpoint folder; for a repository, its name and the commit in the local cache."""
    if Path(path).is_dir():
        return tree_hash(checkpoint_files(Path(path)))
    folder = cached_folder(path)
    return path if folder is None else f"{path}@{folder.name}"


def checkpoint_files(folder: Path) -> dict[str, str]:
    """Return name -> SHA-256 of the files of a checkpoint."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and path.name not in NOT_THE_CHECKPOINT)
    return {path.name: file_hash(path) for path in files}


def tree_hash(files: Mapping[str, str]) -> str:
    """Return one SHA-256 over the lines ``<sha256>  <name>`` in the order of names, as sha256sum prints them."""
    lines = "".join(f"{files[name]}  {name}\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()
