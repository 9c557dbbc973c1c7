"""Read formulas from JSON, as metadata files write them: nested lists, objects, or both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula import (
    MAX_DEPTH,
    OPERATORS,
    Formula,
    is_operator,
    takes_number,
)
from lerobot_memobench.tasks.formula_making import make_atom, make_operator

_KEYS = ", ".join(map(repr, OPERATORS))


def parse_formula(value: Any, where: str = "formula") -> Formula:
    """Read a formula from nested lists or JSON objects.

    ``["And", ["On", "a", "b"]]`` and ``{"and": [["on", "a", "b"]]}`` are the same. Words are read in any
    case, the two shapes may be mixed, and an operator may hold a bare atom instead of a list. A number stands before
    the formula: ``["exactly", 2, ["open", "a"]]``, ``{"exactly": [2, ["open", "a"]]}``. Raises ``MemobenchError``
    whose message starts with ``where``.
    """
    return _parse(value, where, 0)


def _parse(value: Any, where: str, depth: int) -> Formula:
    if depth > MAX_DEPTH:
        raise MemobenchError(f"{where}: found a formula nested deeper than {MAX_DEPTH} levels, expected a flatter one")
    if isinstance(value, Mapping):
        head, items = _from_object(value, where)
    elif isinstance(value, (list, tuple)) and value and isinstance(value[0], str):
        head, items = value[0], value[1:]
    else:
        raise MemobenchError(f"{where}: found {short(value)}, expected a formula such as ['on', 'a', 'b']")
    if is_operator(head):
        numbered = takes_number(head) and items and not isinstance(items[0], (list, tuple, Mapping))
        number, parts = (items[0], items[1:]) if numbered else (None, items)
        return make_operator(head, [_parse(item, where, depth + 1) for item in parts], where, number)
    for item in items:
        if not isinstance(item, str) or not item:
            raise MemobenchError(f"{where}: found {short(item)} as an argument of {head!r}, expected an entity name")
    return make_atom(head, items, where)


def _from_object(value: Mapping[Any, Any], where: str) -> tuple[str, Sequence[Any]]:
    """Return the operator of a JSON object and what it holds."""
    if len(value) != 1:
        raise MemobenchError(f"{where}: found an object with {len(value)} keys, expected one of {_KEYS}")
    ((head, rest),) = value.items()
    if not isinstance(head, str) or not is_operator(head):
        raise MemobenchError(f"{where}: found the key {head!r}, expected one of {_KEYS}")
    # {"not": ["on", "a", "b"]} and {"not": {"and": ...}} hold one formula, not a list of them.
    bare = isinstance(rest, Mapping) or (isinstance(rest, (list, tuple)) and rest and isinstance(rest[0], str))
    items = [rest] if bare else rest
    if not isinstance(items, (list, tuple)):
        raise MemobenchError(f"{where}: found {short(rest)} under {head!r}, expected a list of formulas")
    return head, items


def short(value: Any) -> str:
    """Return a value as messages show it: as Python writes it, at most 40 characters."""
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
