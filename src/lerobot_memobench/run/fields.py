"""Which settings a LeRobot command has and which values they take: read from its dataclasses."""

from __future__ import annotations

import dataclasses
import enum
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any, Literal, Union

import draccus

from lerobot_memobench.errors import MemobenchError, nearest

#: Keys that LeRobot's parser understands beside the fields of a registry (``--policy.type``) or of a command.
CHOICE_KEYS = ("type", "discover_packages_path")
PATH_KEY = "path"
CONFIG_KEY = "config_path"

#: Given a dotted key of a registry field (``policy``), the chosen class; None when nothing is chosen.
Chosen = Callable[[str], type | None]


def is_registry(annotation: Any) -> bool:
    """Return whether a field is chosen by ``.type`` among registered classes."""
    return isinstance(annotation, type) and issubclass(annotation, draccus.ChoiceRegistry)


def field_types(cls: type) -> dict[str, Any]:
    """Return field name -> annotation without its None, for the fields that can be set."""
    hints = typing.get_type_hints(cls)
    return {field.name: without_none(hints[field.name]) for field in dataclasses.fields(cls) if field.init}


def without_none(annotation: Any) -> Any:
    """Return the annotation without its None: ``int`` for ``int | None``."""
    if typing.get_origin(annotation) in (Union, types.UnionType):
        parts = [part for part in typing.get_args(annotation) if part is not type(None)]
        return parts[0] if len(parts) == 1 else Union[tuple(parts)]  # noqa: UP007 - built at run time
    return annotation


def registry(config: type, key: str) -> dict[str, type]:
    """Return name -> class of what may be chosen for a registry field such as ``policy``."""
    choices = field_types(config)[key].get_known_choices()
    return {str(name): choice for name, choice in choices.items()}


def all_keys(config: type, chosen: Chosen, before: str = "") -> Iterator[str]:
    """Yield every dotted key that may be set."""
    for name, annotation in field_types(config).items():
        key = before + name
        if is_registry(annotation):
            choice = chosen(key)
            yield from (f"{key}.{word}" for word in (*CHOICE_KEYS[:1], PATH_KEY))
            if choice is not None:
                yield from all_keys(choice, chosen, key + ".")
        elif dataclasses.is_dataclass(annotation):
            yield from all_keys(typing.cast(type, annotation), chosen, key + ".")
        else:
            yield key


def annotation_of(config: type, key: str, chosen: Chosen) -> Any:
    """Return the annotation of the field at a dotted key; ``Any`` where it cannot be known.

    Raises:
        KeyError: there is no such field. MemobenchError: the key belongs to a choice that has not been made
            (``env.horizon`` without an environment).
    """
    if key == CONFIG_KEY:
        return str
    cls = config
    parts = key.split(".")
    for k, part in enumerate(parts[:-1]):
        annotation = _field(cls, part, key)
        if is_registry(annotation):
            if k == len(parts) - 2 and parts[-1] in (*CHOICE_KEYS, PATH_KEY):
                return str
            choice = chosen(".".join(parts[: k + 1]))
            if choice is None and k == 0:
                raise MemobenchError(f"{key!r} needs {part}=: name one before setting something of it")
            annotation = choice
        if not dataclasses.is_dataclass(annotation):
            return Any  # a dict, a union, a choice made elsewhere: LeRobot's parser decides
        cls = typing.cast(type, annotation)
    return _field(cls, parts[-1], key)


def _field(cls: type, name: str, key: str) -> Any:
    known = field_types(cls)
    if name not in known:
        raise KeyError(key)
    return known[name]


def checked_value(key: str, annotation: Any, text: str) -> str:
    """Return ``text`` as LeRobot's parser reads it, after a check against the field's type.

    Raises:
        MemobenchError: the value cannot be one of this field.
    """
    if text in ("null", "~"):
        return text
    if annotation in (bool, int, float):
        # For text, a word such as `align=none` is a value.
        return "null" if text.lower() == "none" else _checked_plain(key, annotation, text)
    if typing.get_origin(annotation) is Literal:
        values = [str(value) for value in typing.get_args(annotation)]
        _check_known(key, text, values, values)
    elif isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        values = [str(member.value) for member in annotation]
        _check_known(key, text, [*values, *annotation.__members__], list(annotation.__members__))
    return text


def _checked_plain(key: str, annotation: type, text: str) -> str:
    """Return the text of a truth value or number."""
    if annotation is bool:
        if text.lower() not in ("true", "false"):
            raise MemobenchError(f"{key}={text}: expected true or false")
        return text.lower()
    plain = text.replace("_", "") if annotation is int else text
    try:
        annotation(plain)
    except ValueError:
        word = "a whole number" if annotation is int else "a number"
        raise MemobenchError(f"{key}={text}: expected {word}") from None
    return plain


def _check_known(key: str, text: str, known: list[str], named: list[str]) -> None:
    if text not in known:
        raise MemobenchError(f"{key}={text}: {nearest(text, named)}")
