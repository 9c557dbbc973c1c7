"""Overrides and names from LeRobot's command line, and its log lines kept quiet."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml


def overrides(key: str, flags: Sequence[str] | None = None) -> list[str]:
    """Return what flags, LeRobot's command line when None, set of a choice such as ``policy``, as draccus reads it."""
    from lerobot.configs import parser

    told = parser.get_cli_overrides(key, flags) or []
    # LeRobot's parser takes these out before draccus reads.
    return [flag for flag in told if not flag.startswith("--discover_packages_path")]


@contextmanager
def quiet() -> Iterator[None]:
    """Keep LeRobot's log lines about plugins and configurations to the run itself, which reads them again."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)


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


def in_file(*keys: str, flags: Sequence[str] | None = None) -> Any | None:
    """Return what a local file of LeRobot's settings, or the one in a checkpoint's folder, says; None without one."""
    from lerobot.configs import parser

    path = parser.parse_arg("config_path", flags)
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
