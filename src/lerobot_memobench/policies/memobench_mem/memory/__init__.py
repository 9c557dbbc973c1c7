"""Memory mechanisms, one file each, by their names. `mechanism` is their interface.

Another package brings one by an entry point: its name and class in the group ``lerobot_memobench.memories``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import draccus

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism

GROUP = "lerobot_memobench.memories"
NONE = "none"
OURS = {
    "frames": "Frames",
    "bank": "Bank",
    "motion": "Motion",
    "subgoal": "Subgoal",
    "keyframes": "Keyframes",
    "recurrent": "Recurrent",
    "fast_weights": "FastWeights",
}
"""Name, which is the module's too -> class."""


def mechanism_names() -> list[str]:
    """Return the names of all mechanisms, those of other packages behind ours; without ``none``."""
    return [*OURS, *sorted({point.name for point in entry_points(group=GROUP)} - {*OURS, NONE})]


@cache
def find_mechanism(name: str) -> type[MemoryMechanism]:
    """Return a mechanism by its name.

    Raises:
        MemobenchError: there is none, or the package that brings it is broken.
    """
    if name in OURS:
        found = [EntryPoint(name, f"{__name__}.{name}:{OURS[name]}", GROUP)]
    else:
        found = [point for point in entry_points(group=GROUP) if point.name == name]
    if not found:
        known = [NONE, *mechanism_names()]
        raise MemobenchError(f"There is no memory '{name}': {nearest(name, known)} Pass --policy.memory=<one of them>.")
    try:
        made = found[0].load()
    except Exception as error:
        raise MemobenchError(
            f"The memory '{name}' ({found[0].value}) cannot be imported: {type(error).__name__}: {error}; mend or "
            "remove the package that brings it."
        ) from error
    if not (isinstance(made, type) and issubclass(made, MemoryMechanism)):
        raise MemobenchError(
            f"The memory '{name}' ({found[0].value}) is no subclass of MemoryMechanism "
            "(lerobot_memobench.policies.memobench_mem.memory.mechanism)."
        )
    return made


def settings_of_another(name: str, given: Mapping[str, Any]) -> str | None:
    """Return one of our mechanisms whose settings, all of them, are ``given``, and do not fit this mechanism."""
    if set(given) <= _settings(name):
        return None
    return next((other for other in OURS if _settings(other) == set(given)), None)


def _settings(name: str) -> set[str]:
    return {one.name for one in fields(find_mechanism(name).Settings)}


def read_settings(name: str, given: Mapping[str, Any]) -> Any:
    """Return the settings of a mechanism, its defaults where nothing is ``given``.

    Raises:
        MemobenchError: a setting is unknown, or of another type.
    """
    known = _settings(name)
    for key in given:
        if key not in known:
            told = nearest(key, known) if known else "it has none."
            raise MemobenchError(f"policy.memory_settings names '{key}', which is no setting of memory={name}; {told}")
    try:
        return draccus.decode(find_mechanism(name).Settings, dict(given))
    except Exception as error:  # draccus answers by its own kinds of error
        raise MemobenchError(
            f"policy.memory_settings={dict(given)} of memory={name} cannot be read: {error.__cause__ or error}"
        ) from None
