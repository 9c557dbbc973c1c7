"""Memory mechanisms by name, one file each; `mechanism` is their interface.

A package adds a mechanism by an entry point in the group ``lerobot_memobench.memories``: its name and class.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, get_type_hints

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism
from lerobot_memobench.untrusted import Malformed, checked

logger = logging.getLogger(__name__)

GROUP = "lerobot_memobench.memories"
NONE = "none"
OURS = {
    "frames": "FrameSampling",
    "bank": "Bank",
    "motion": "Motion",
    "subgoal": "Subgoal",
    "keyframes": "Keyframes",
    "recurrent": "Recurrent",
    "fast_weights": "FastWeights",
}
"""Name of a mechanism and of its module -> class."""


def mechanism_names() -> list[str]:
    """Return the names of all mechanisms except ``none``: ours, then those of other packages."""
    return [*OURS, *sorted({point.name for point in entry_points(group=GROUP)} - {*OURS, NONE})]


@cache
def find_mechanism(name: str) -> type[MemoryMechanism]:
    """Return a mechanism; a `MemobenchError` if its name is unknown or ambiguous, or its package is broken."""
    points = [point for point in entry_points(group=GROUP) if point.name == name]
    if name in OURS:
        for point in points:
            logger.warning("the memory '%s' of a package (%s) is ignored: it has the name of ours", name, point.value)
        points = [EntryPoint(name, f"{__name__}.{name}:{OURS[name]}", GROUP)]
    if not points:
        known = [NONE, *mechanism_names()]
        raise MemobenchError(f"unknown memory '{name}': {nearest(name, known)} Pass --policy.memory=<one of them>.")
    if len({point.value for point in points}) > 1:
        classes = " and ".join(sorted(point.value for point in points))
        raise MemobenchError(f"several memories '{name}' ({classes}); remove a package, or rename its entry point.")
    try:
        mechanism = points[0].load()
    except Exception as error:
        raise MemobenchError(
            f"the memory '{name}' ({points[0].value}) cannot be imported: {type(error).__name__}: {error}; repair or "
            "remove its package."
        ) from error
    fits = isinstance(mechanism, type) and issubclass(mechanism, MemoryMechanism)
    if not (fits and is_dataclass(mechanism.Settings)):
        raise MemobenchError(
            f"the memory '{name}' ({points[0].value}) is no subclass of MemoryMechanism "
            "(lerobot_memobench.policies.memobench_mem.memory.mechanism) with a dataclass as its Settings."
        )
    return mechanism


def settings_of_another(name: str, values: Mapping[str, Any]) -> str | None:
    """Return another mechanism whose settings are all in ``values`` and include those that this mechanism lacks."""
    strange = set(values) - setting_names(name)
    if not strange:
        return None
    for other in mechanism_names():
        with suppress(MemobenchError):  # of a broken package
            if strange <= setting_names(other) <= set(values):
                return other
    return None


def setting_names(name: str) -> set[str]:
    """Return the names of a mechanism's settings."""
    return {setting.name for setting in fields(find_mechanism(name).Settings)}


def mechanism_settings(name: str, values: Mapping[str, Any]) -> Any:
    """Return the settings of a mechanism, with defaults for those that ``values`` lacks.

    A `MemobenchError` if a setting is unknown, or has a wrong type or value.
    """
    settings, known = find_mechanism(name).Settings, setting_names(name)
    for key, value in values.items():
        if key not in known:
            hint = nearest(key, known) if known else "it has no settings."
            raise MemobenchError(f"policy.memory_settings: unknown setting '{key}' for memory={name}; {hint}")
        kind = get_type_hints(settings)[key]
        try:
            checked(value, kind)
        except Malformed:
            expected = kind.__name__ if isinstance(kind, type) else kind
            raise MemobenchError(
                f"policy.memory_settings: found {key}={value!r} for memory={name}; expected {expected}"
            ) from None
    try:
        return settings(**values)
    except ValueError as error:
        raise MemobenchError(f"policy.memory_settings of memory={name} cannot be used: {error}") from None
