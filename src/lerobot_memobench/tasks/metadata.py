"""Read a task's metadata file: checkpoints, prompt, variants, and keys of the strict suite.

The types below list the keys of the file for K checkpoints. Unknown keys of the file itself are kept in
``Task.metadata``; unknown keys of a prompt or a variant are errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict, cast

from annotated_types import Ge, Le, Len, MinLen

from lerobot_memobench.errors import MemobenchError, nearest, short
from lerobot_memobench.tasks.bddl import Problem
from lerobot_memobench.tasks.formula import Formula, parse_formula, rename
from lerobot_memobench.tasks.task import (
    EASY,
    OPERATIONS,
    Checkpoint,
    Difficulty,
    MemoryType,
    Prompt,
    PromptKind,
    Suite,
    Texts,
    Variant,
)
from lerobot_memobench.untrusted import read_json

LevelTexts = Annotated[list[str], Len(3, 3)]
LevelLabels = Annotated[list[Annotated[int, Ge(0), Le(2)]], Len(3, 3)]
ADVICE = (
    "expected an object with 'memory' (three texts per checkpoint: coarse, intermediate, fine), 'operating_type' "
    "(three labels per checkpoint: 0 Storage, 1 Update, 2 Compression) and 'subtask_goals' (one formula per checkpoint)"
)


class PromptData(TypedDict):
    """A demonstration prompt: ``target`` for pick, point and highlight, pairs of object and drawer for hide."""

    kind: PromptKind
    target: NotRequired[str | None]
    places: NotRequired[list[Annotated[list[str], Len(2, 2)]]]


class VariantData(TypedDict):
    """A variant of the task, see `task.Variant`: K lists of three texts, K formulas."""

    memory: list[LevelTexts]
    substitute: NotRequired[dict[str, str]]
    order: NotRequired[list[int] | None]
    subtask_goals: NotRequired[list[Any] | None]
    goal: NotRequired[Any]
    demo_summary: NotRequired[str]
    language: NotRequired[str]
    prompt: NotRequired[PromptData | None]
    replaces_published: NotRequired[bool]
    difficulty: NotRequired[Difficulty]


class MetadataFile(TypedDict):
    """The file: K entries in each list. The last seven keys are this project's, not the published format's."""

    memory: list[LevelTexts]  # coarse, intermediate, fine
    operating_type: list[LevelLabels]  # 0 Storage, 1 Update, 2 Compression
    subtask_goals: Annotated[list[Any], MinLen(1)]  # formulas
    key_frame: NotRequired[list[int]]  # -1 if unknown
    timestep_exec_start_idx: NotRequired[int | list[int]]  # first frame of the execution in each demonstration
    demo_summary: NotRequired[str]
    memory_type: NotRequired[MemoryType]
    family: NotRequired[str]
    prompt: NotRequired[PromptData | None]
    variants: NotRequired[list[VariantData]]
    suite: NotRequired[Suite]
    derived_from: NotRequired[str | None]
    drawn: NotRequired[bool]
    spoilt_as: NotRequired[Literal["miscount", "wrong_place"] | None]


class Metadata:
    """Content of a metadata file; its methods raise `MemobenchError` with file and key."""

    def __init__(self, path: Path, problem: Problem) -> None:
        self.path, self.problem = path, problem  # the problem declares the names
        try:
            self.data: dict[str, Any] = read_json(path, MetadataFile, ADVICE)
        except FileNotFoundError:
            raise MemobenchError(f"{path} is missing; {ADVICE}") from None

    def _error(self, key: str, found: Any, expected: str) -> MemobenchError:
        return MemobenchError(f"{self.path}: found {key} = {short(found)}, expected {expected}")

    def _check_count(self, key: str, values: list[Any]) -> None:
        count = len(self.data["subtask_goals"])
        if len(values) != count:
            raise self._error(key, values, f"a list of {count} entries, one per subtask goal")

    def _check_keys(self, key: str, value: Mapping[str, Any], kind: type) -> None:
        known = kind.__annotations__
        for name in value:
            if name not in known:
                raise self._error(key, value, f"only the keys {', '.join(known)}; {nearest(name, known)}")

    def _check_name(self, name: str, key: str) -> None:
        if name not in self.problem.names:
            hint = nearest(name, self.problem.names)
            raise self._error(key, name, f"a name that the BDDL file declares, {hint}")

    def checkpoints(self) -> tuple[Checkpoint, ...]:
        """Return the checkpoints."""
        labels = self.data["operating_type"]
        self._check_count("operating_type", labels)
        formulas = self._formulas(self.data["subtask_goals"], "subtask_goals")
        operations = [(OPERATIONS[a], OPERATIONS[b], OPERATIONS[c]) for a, b, c in labels]
        texts = self._texts(self.data["memory"], "memory")
        return tuple(Checkpoint(*parts) for parts in zip(formulas, operations, texts, strict=True))

    def _texts(self, value: list[list[str]], key: str) -> tuple[Texts, ...]:
        self._check_count(key, value)
        for k, levels in enumerate(value):
            if not all(text.strip() for text in levels):
                raise self._error(f"{key}[{k}]", levels, "three texts: coarse, intermediate, fine")
        return tuple(cast(Texts, tuple(levels)) for levels in value)

    def _formula(self, value: Any, key: str) -> Formula:
        where = f"{self.path}, {key}"
        return self.problem.resolve(parse_formula(value, where), where)

    def _formulas(self, values: list[Any], key: str) -> tuple[Formula, ...]:
        return tuple(self._formula(value, f"{key}[{k}]") for k, value in enumerate(values))

    def prompt(self, value: PromptData | None, key: str = "prompt") -> Prompt | None:
        """Return a demonstration prompt; None for null."""
        if value is None:
            return None
        self._check_keys(key, value, PromptData)
        kind, target, places = value["kind"], value.get("target"), value.get("places", [])
        if (kind == "hide") != bool(places):
            raise self._error(f"{key}.places", places, "a list of [object, drawer] for kind 'hide' only")
        if target is None and kind not in ("routine", "hide"):
            raise self._error(f"{key}.target", target, f"the object that a prompt of kind {kind!r} shows")
        for thing, drawer in places:
            if thing not in self.problem.objects or drawer not in self.problem.regions:
                raise self._error(f"{key}.places", places, "declared objects and regions, as [object, drawer]")
        if target is not None:
            self._check_name(target, f"{key}.target")
        return Prompt(kind, target, tuple((thing, drawer) for thing, drawer in places))

    def variants(self) -> tuple[Variant, ...]:
        """Return the variants."""
        return tuple(self._variant(item, f"variants[{k}]") for k, item in enumerate(self.data.get("variants", [])))

    def _variant(self, value: VariantData, key: str) -> Variant:
        self._check_keys(key, value, VariantData)
        substitute, order, goals = value.get("substitute", {}), value.get("order"), value.get("subtask_goals")
        self._check_substitute(substitute, f"{key}.substitute")
        if order is not None and sorted(order) != list(range(len(self.data["subtask_goals"]))):
            raise self._error(f"{key}.order", order, "the index of each subtask goal once")
        if goals is not None:
            self._check_count(f"{key}.subtask_goals", goals)
        return Variant(
            languages=self._texts(value["memory"], f"{key}.memory"),
            substitute=substitute,
            order=None if order is None else tuple(order),
            goals=None if goals is None else self._formulas(goals, f"{key}.subtask_goals"),
            goal=None if value.get("goal") is None else self._formula(value["goal"], f"{key}.goal"),
            demo_summary=value.get("demo_summary", ""),
            language=value.get("language", ""),
            prompt=self.prompt(value.get("prompt"), f"{key}.prompt"),
            replaces_published=value.get("replaces_published", False),
            difficulty=value.get("difficulty", EASY),
        )

    def _check_substitute(self, substitute: Mapping[str, str], key: str) -> None:
        """Check names and substituted formulas, so that ``Task.variant(k)`` cannot fail later."""
        for old, new in substitute.items():
            self._check_name(old, key)
            self._check_name(new, f"{key}[{old!r}]")
        checkpoints = self._formulas(self.data["subtask_goals"], "subtask_goals")
        for k, goal in enumerate((self.problem.goal, *checkpoints)):
            which = "goal" if k == 0 else f"checkpoint {k - 1}"
            self.problem.resolve(rename(goal, substitute), f"{self.path}, {key} ({which})")
