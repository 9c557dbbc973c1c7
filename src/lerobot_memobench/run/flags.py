"""LeRobot's flags as a list of words: ``--key=value`` and ``--key value`` mean the same."""

from __future__ import annotations

from collections.abc import Sequence


def flag_value(flags: Sequence[str], key: str) -> str | None:
    """Return the value of ``--key`` among flags, in either spelling; the last one counts."""
    found = None
    for k, flag in enumerate(flags):
        if flag.startswith(f"--{key}="):
            found = flag.split("=", 1)[1]
        elif flag == f"--{key}" and k + 1 < len(flags) and not flags[k + 1].startswith("--"):
            found = flags[k + 1]
    return found


def has_flag(flags: Sequence[str], key: str) -> bool:
    """Return whether ``--key`` is given, with or without a value."""
    return any(flag == f"--{key}" or flag.startswith(f"--{key}=") for flag in flags)


def without_flag(flags: Sequence[str], key: str) -> list[str]:
    """Return the flags without ``--key`` and its value, in either spelling."""
    kept, value_follows = [], False
    for flag in flags:
        if value_follows and not flag.startswith("--"):
            value_follows = False
            continue
        value_follows = flag == f"--{key}"
        if not value_follows and not flag.startswith(f"--{key}="):
            kept.append(flag)
    return kept


def joined_flags(flags: Sequence[str]) -> list[str]:
    """Return ``--key value`` as ``--key=value``."""
    found: list[str] = []
    for flag in flags:
        if not flag.startswith("--") and found and found[-1].startswith("--") and "=" not in found[-1]:
            found[-1] += f"={flag}"
        else:
            found.append(flag)
    return found


def whole_number(text: str | None) -> int | None:
    """Return the whole number that a flag's value is, None when it is none."""
    try:
        return int(text) if text is not None else None
    except ValueError:
        return None
