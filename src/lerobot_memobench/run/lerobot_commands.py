"""The commands of the installed LeRobot: which there are, what configures them, how they are called in this process."""

from __future__ import annotations

import dataclasses
import sys
import typing
from collections.abc import Callable, Sequence
from functools import cache
from importlib import metadata
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.threads import ACTING, LEARNING, use_threads
from lerobot_memobench.policies.lerobot_config import quiet

PREFIX = "lerobot-"
ROLES = {"eval": ACTING, "train": LEARNING}
"""What the processes of commands do that compute: `jobs.threads`."""


def lerobot_commands() -> dict[str, metadata.EntryPoint]:
    """Return name -> entry point of every command of the installed LeRobot (``eval``: ``lerobot-eval``)."""
    return {
        entry.name.removeprefix(PREFIX): entry
        for entry in metadata.distribution("lerobot").entry_points
        if entry.group == "console_scripts" and entry.name.startswith(PREFIX)
    }


def load_command(name: str) -> Callable[[], Any]:
    """Return the main function of a LeRobot command, which reads ``sys.argv``. The import takes many seconds.

    Raises:
        MemobenchError: LeRobot was installed without what it needs.
    """
    if name in ROLES:
        use_threads(ROLES[name])
    try:
        entry: Callable[[], Any] = lerobot_commands()[name].load()
    except ImportError as error:
        raise MemobenchError(f"{PREFIX}{name} needs what is not installed here: {error}") from error
    return entry


@cache
def register_plugins() -> None:
    """Let LeRobot find its plugins as its own commands do, once per process, without the log lines about it."""
    from lerobot.utils.import_utils import register_third_party_plugins

    with quiet():
        register_third_party_plugins()


def config_class(entry: Callable[[], Any]) -> type | None:
    """Return the configuration dataclass of a LeRobot command, None where it uses plain argparse.

    LeRobot wraps the function that takes the configuration, in the module of the command's main function.
    """
    for function in vars(sys.modules[entry.__module__]).values():
        inner = getattr(function, "__wrapped__", None)
        if inner is None or getattr(function, "__module__", None) != entry.__module__:
            continue
        try:
            hints = typing.get_type_hints(inner)
        except NameError:  # a type that is imported for checkers only
            hints = getattr(inner, "__annotations__", {})
        first = next(iter(hints.values()), None)
        if dataclasses.is_dataclass(first):
            return typing.cast(type, first)
    return None


def call_lerobot(command: str, flags: Sequence[str]) -> int:
    """Run ``lerobot-<command>`` with these flags; return its exit status. Its main function reads ``sys.argv``."""
    entry = load_command(command)
    before = sys.argv
    sys.argv = [f"{PREFIX}{command}", *flags]
    try:
        status = entry()
    except SystemExit as stop:
        status = stop.code
    finally:
        sys.argv = before
    if status is None:
        return 0
    if isinstance(status, int):
        return status
    print(status, file=sys.stderr)  # as Python does with such a status
    return 1
