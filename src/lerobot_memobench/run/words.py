"""A command line in words: ``key=value`` taken apart, flags left as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.flags import flag_value


@dataclass(frozen=True)
class Words:
    """A command line after ``lerobot <name>``, taken apart.

    Attributes:
        settings: (key, value) of every ``key=value``, in order.
        flags: everything from ``--…`` on, untouched, values in words of their own included.
    """

    settings: list[tuple[str, str]] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)

    @property
    def wants_help(self) -> bool:
        """Whether ``-h`` or ``--help`` is among the flags."""
        return any(flag in ("-h", "--help") for flag in self.flags)

    def value(self, key: str) -> str | None:
        """Return what ``key=`` says last, else what ``--key`` does."""
        return dict(self.settings).get(key, flag_value(self.flags, key))


def split_words(words: Sequence[str]) -> Words:
    """Take a command line apart.

    Raises:
        MemobenchError: a word is neither ``key=value`` nor a flag nor a flag's value.
    """
    result = Words()
    after_flag = False  # the word before was `--flag` without `=`: this one may be its value
    for word in words:
        is_flag = word.startswith("-") and word != "-"
        key, equals, value = word.partition("=")
        if is_flag or after_flag:
            result.flags.append(word)
        elif equals and key.replace("_", "").replace(".", "").replace("-", "").isalnum():
            result.settings.append((key, value))
        else:
            raise MemobenchError(f"found {word!r} among the arguments; expected key=value or --flag=value")
        after_flag = is_flag and word.startswith("--") and not equals
    return result


def executor_options(given: Sequence[str]) -> dict[str, Any]:
    """Return ``key=value`` words (``executor_option=partition=cpu``) as arguments: numbers, truth values and nothing
    (``none``) as such. In the words of another program (``srun_args.mpi=none``) that is a name.
    """
    plain: dict[str, bool | None] = {"true": True, "false": False}
    options: dict[str, Any] = {}
    for word in given:
        key, equals, value = word.partition("=")
        if not key or not equals:
            raise MemobenchError(f"found executor option {word!r}, expected key=value, such as partition=cpu")
        known = plain if "." in key else {**plain, "none": None, "null": None}
        options[key] = int(value) if value.isdecimal() else known.get(value.lower(), value)
    return options
