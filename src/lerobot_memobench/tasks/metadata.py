"""Read a task's metadata file: checkpoints, prompt, variants, and keys of the strict suite.

Keys (K checkpoints): ``memory`` (K lists of three texts: coarse, intermediate, fine), ``operating_type`` (K lists of
three labels, 0 Storage, 1 Update, 2 Compression, per text level), ``subtask_goals`` (K formulas). Optional:
``key_frame`` (K integers), ``timestep_exec_start_idx`` (integer or list of integers), ``demo_summary`` (text). Optional
keys of this project: ``memory_type``, ``family``, ``prompt`` ({"kind", "target"}), ``variants`` (list of {"memory", and
optionally "substitute", "order", "subtask_goals", "goal", "demo_summary", "language", "prompt", "replaces_published"}),
and for the strict suite ``suite``, ``derived_from``, ``drawn``, ``spoilt_as`` (see `Task`). A hiding is the prompt
{"kind": "hide", "places": [[object, drawer], ...]}. ``Task.metadata`` keeps all keys.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.bddl import Problem
from lerobot_memobench.tasks.formula import Formula, parse_formula, rename, short_repr
from lerobot_memobench.tasks.task import (
    OPERATIONS,
    Checkpoint,
    Operation,
    Prompt,
    PromptKind,
    Texts,
    Variant,
)

_REQUIRED = ("memory", "operating_type", "subtask_goals")
_VARIANT_KEYS = {
    "memory",
    "substitute",
    "order",
    "subtask_goals",
    "goal",
    "demo_summary",
    "language",
    "prompt",
    "replaces_published",
}
METADATA_CONTENT = (
    "'memory' (three texts per checkpoint: coarse, intermediate, fine), 'operating_type' (three labels per checkpoint: "
    "0 Storage, 1 Update, 2 Compression), 'subtask_goals' (one formula per checkpoint) and 'key_frame' (-1 per "
    "checkpoint)"
)
"""Content of a metadata file, for error messages."""


class Metadata:
    """Content of a metadata file; each method checks its keys and raises `MemobenchError`.

    Args:
        path: path of the file, for messages.
        problem: BDDL problem of the same folder; declares the names.
        data: content of the file; {} without a file, for a task without checkpoints.
    """

    def __init__(self, path: Path, problem: Problem, data: dict[str, Any]) -> None:
        self.path, self.problem, self.data = path, problem, data

    @classmethod
    def read(cls, path: Path, problem: Problem) -> Metadata:
        """Read a file and check its required keys."""
        data = json_object(path)
        missing = [key for key in _REQUIRED if key not in data]
        if missing:
            lacks = ", ".join(map(repr, missing))
            raise MemobenchError(f"{path} lacks {lacks}, expected an object that holds {METADATA_CONTENT}")
        return cls(path, problem, data)

    def _error(self, place: str, found: Any, expected: str) -> MemobenchError:
        return MemobenchError(f"{self.path}: found {place} = {short_repr(found)}, expected {expected}")

    def text(self, key: str) -> str:
        """Return an optional text; "" by default."""
        return _text(self.data, key, str(self.path))

    def choice(self, key: str, allowed: Sequence[str], default: str | None = None) -> Any:
        """Return an optional word out of ``allowed``, or the default."""
        value = self.data.get(key, default)
        if value != default and value not in allowed:
            raise self._error(key, value, f"one of {', '.join(allowed)}")
        return value

    def flag(self, key: str) -> bool:
        """Return an optional boolean; False by default."""
        value = self.data.get(key, False)
        if not isinstance(value, bool):
            raise self._error(key, value, "true or false")
        return value

    # --- checkpoints ---

    def checkpoints(self) -> tuple[Checkpoint, ...]:
        """Return the checkpoints; empty without a file."""
        if not self.data:
            return ()
        goals = self.data["subtask_goals"]
        if not isinstance(goals, list) or not goals:
            raise self._error("subtask_goals", goals, "a list of at least one formula")
        operations = self._operations(len(goals))
        self._check_frames(len(goals))
        texts = self._texts(self.data["memory"], "memory", len(goals))
        formulas = self._formulas(goals, "subtask_goals")
        return tuple(Checkpoint(*parts) for parts in zip(formulas, operations, texts, strict=True))

    def _operations(self, count: int) -> list[tuple[Operation, Operation, Operation]]:
        labels = self.data["operating_type"]
        if not isinstance(labels, list) or len(labels) != count:
            raise self._error("operating_type", labels, f"a list of {count} entries, one per subtask goal")
        for k, label in enumerate(labels):
            if not isinstance(label, list) or len(label) != 3 or not all(_is_int(x) and 0 <= x <= 2 for x in label):
                raise self._error(f"operating_type[{k}]", label, "three labels, each 0, 1 or 2")
        return [(OPERATIONS[a], OPERATIONS[b], OPERATIONS[c]) for a, b, c in labels]

    def _check_frames(self, count: int) -> None:
        frames = self.data.get("key_frame", [-1] * count)
        if not isinstance(frames, list) or len(frames) != count or not all(map(_is_int, frames)):
            raise self._error("key_frame", frames, f"a list of {count} integers, -1 where unknown")
        start = self.data.get("timestep_exec_start_idx", -1)
        if not _is_int(start) and not (isinstance(start, list) and all(map(_is_int, start))):
            raise self._error("timestep_exec_start_idx", start, "an integer or a list of integers")

    def _texts(self, value: Any, place: str, count: int) -> tuple[Texts, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise self._error(place, value, f"a list of {count} entries, one per subtask goal")
        for k, levels in enumerate(value):
            if (
                not isinstance(levels, list)
                or len(levels) != 3
                or not all(isinstance(text, str) and text.strip() for text in levels)
            ):
                raise self._error(f"{place}[{k}]", levels, "three texts: coarse, intermediate, fine")
        return tuple(cast(Texts, tuple(levels)) for levels in value)

    def _formula(self, value: Any, place: str) -> Formula:
        where = f"{self.path}, {place}"
        return self.problem.resolve(parse_formula(value, where), where)

    def _formulas(self, values: list[Any], place: str) -> tuple[Formula, ...]:
        return tuple(self._formula(value, f"{place}[{k}]") for k, value in enumerate(values))

    # --- prompt ---

    def prompt(self) -> Prompt | None:
        """Return the demonstration prompt of the key ``prompt``; null means none."""
        value = self.data["prompt"]
        return None if value is None else self._prompt(value, "prompt")

    def _prompt(self, value: Any, place: str) -> Prompt:
        if not isinstance(value, dict) or not set(value) <= {"kind", "target", "places"}:
            raise self._error(place, value, 'null or {"kind": ..., "target": ...}')
        kind = value.get("kind")
        if kind not in get_args(PromptKind):
            raise self._error(f"{place}.kind", kind, f"one of {', '.join(get_args(PromptKind))}")
        target, places = value.get("target"), self._places(value.get("places", []), f"{place}.places")
        if (kind == "hide") != bool(places):
            raise self._error(f"{place}.places", places, "a list of [object, drawer] for kind 'hide' only")
        if target is None and kind not in ("routine", "hide"):
            raise self._error(f"{place}.target", target, f"the object that a prompt of kind {kind!r} shows")
        named = None if target is None else self._name(target, f"{place}.target")
        return Prompt(cast(PromptKind, kind), named, places)

    def _places(self, value: Any, place: str) -> tuple[tuple[str, str], ...]:
        if not isinstance(value, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in value):
            raise self._error(place, value, "a list of [object, drawer]")
        found = tuple((self._name(thing, place), self._name(drawer, place)) for thing, drawer in value)
        if any(thing not in self.problem.objects or drawer not in self.problem.regions for thing, drawer in found):
            raise self._error(place, value, "declared objects and regions, as [object, drawer]")
        return found

    def _name(self, value: Any, place: str) -> str:
        kind = self.problem.entity_kind(value) if isinstance(value, str) else None
        if kind is None:
            hint = nearest(str(value), [*self.problem.objects, *self.problem.fixtures, *self.problem.regions])
            raise self._error(place, value, f"a name that the BDDL file declares, {hint}")
        return str(value)

    # --- variants ---

    def variants(self) -> tuple[Variant, ...]:
        """Return the variants; call `checkpoints` before, which validates their keys."""
        value = self.data.get("variants", [])
        if not isinstance(value, list):
            raise self._error("variants", value, "a list of objects")
        return tuple(self._variant(item, f"variants[{k}]") for k, item in enumerate(value))

    def _variant(self, value: Any, place: str) -> Variant:
        if not isinstance(value, dict) or not set(value) <= _VARIANT_KEYS or "memory" not in value:
            others = ", ".join(sorted(_VARIANT_KEYS - {"memory"}))
            raise self._error(place, value, f"an object with 'memory' and any of {others}")
        count = len(self.data["subtask_goals"])
        substitute = self._substitute(value.get("substitute", {}), f"{place}.substitute")
        order = self._order(value.get("order"), f"{place}.order", count)
        goals = value.get("subtask_goals")
        if goals is not None and (not isinstance(goals, list) or len(goals) != count):
            raise self._error(f"{place}.subtask_goals", goals, f"a list of {count} formulas")
        if not isinstance(value.get("replaces_published", False), bool):
            raise self._error(f"{place}.replaces_published", value["replaces_published"], "true or false")
        self._check_substituted(substitute, f"{place}.substitute")
        return Variant(
            languages=self._texts(value["memory"], f"{place}.memory", count),
            substitute=substitute,
            order=order,
            goals=None if goals is None else self._formulas(goals, f"{place}.subtask_goals"),
            goal=None if value.get("goal") is None else self._formula(value["goal"], f"{place}.goal"),
            demo_summary=_text(value, "demo_summary", f"{self.path}, {place}"),
            language=_text(value, "language", f"{self.path}, {place}"),
            prompt=None if value.get("prompt") is None else self._prompt(value["prompt"], f"{place}.prompt"),
            replaces_published=value.get("replaces_published", False),
        )

    def _substitute(self, value: Any, place: str) -> dict[str, str]:
        if not isinstance(value, dict):
            raise self._error(place, value, "an object of names to names")
        return {self._name(old, place): self._name(new, f"{place}[{old!r}]") for old, new in value.items()}

    def _order(self, value: Any, place: str, count: int) -> tuple[int, ...] | None:
        if value is None:
            return None
        if not isinstance(value, list) or not all(map(_is_int, value)) or sorted(value) != list(range(count)):
            raise self._error(place, value, f"each of 0 to {count - 1} once")
        return tuple(value)

    def _check_substituted(self, substitute: Mapping[str, str], place: str) -> None:
        """Resolve the substituted formulas at load time so that ``Task.variant(k)`` cannot fail later."""
        checkpoints = self._formulas(self.data["subtask_goals"], "subtask_goals")
        for k, goal in enumerate((self.problem.goal, *checkpoints)):
            which = "goal" if k == 0 else f"checkpoint {k - 1}"
            self.problem.resolve(rename(goal, substitute), f"{self.path}, {place} ({which})")


# --- files ---


def read_text(path: Path, holds: str) -> str:
    """Return a file's text; ``holds`` describes the expected content in error messages."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise MemobenchError(f"{path} is missing, expected a file that holds {holds}") from None
    except UnicodeDecodeError as error:
        raise MemobenchError(
            f"{path}: found a byte at offset {error.start} that is not UTF-8, expected UTF-8 text"
        ) from None
    except OSError as error:
        raise MemobenchError(f"{path} cannot be read ({error.strerror}), expected a file that holds {holds}") from None


def json_object(path: Path) -> dict[str, Any]:
    """Return the JSON object of a metadata file; a duplicate key is an error."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        for key in keys:
            if keys.count(key) > 1:
                raise MemobenchError(f"{path}: found the key {key!r} twice in one object, expected it once")
        return dict(pairs)

    text = read_text(path, METADATA_CONTENT)
    try:
        data = json.loads(text, object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise MemobenchError(
            f"{path}, line {error.lineno}: found no valid JSON ({error.msg}), expected an object"
        ) from None
    except MemobenchError:
        raise
    except (ValueError, RecursionError) as error:
        raise MemobenchError(f"{path}: found JSON that cannot be read ({error}), expected an object") from None
    if not isinstance(data, dict):
        raise MemobenchError(f"{path}: found {short_repr(data)}, expected a JSON object that holds {METADATA_CONTENT}")
    return data


def _is_int(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _text(data: Mapping[str, Any], key: str, where: str) -> str:
    value = data.get(key, "")
    if not isinstance(value, str):
        raise MemobenchError(f"{where}: found {key} = {short_repr(value)}, expected text")
    return value
