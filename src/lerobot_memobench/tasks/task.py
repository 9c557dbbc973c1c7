"""A task of the benchmark and its loader.

A task is a folder with ``task_config.bddl`` (scene, instruction, goal) and ``task_config.meta.json``
(checkpoints). The project's own catalogue and folders in the published format are read by the same
``load_task``.

Metadata keys (K checkpoints): ``memory`` (K lists of three texts: coarse, intermediate, fine),
``operating_type`` (K lists of three labels, 0 Storage, 1 Update, 2 Compression, per text level),
``subtask_goals`` (K formulas). Optional: ``key_frame`` (K integers), ``timestep_exec_start_idx`` (integer or
list of integers), ``demo_summary`` (text). Of this project, optional too:
``memory_type``, ``family``, ``prompt`` ({"kind", "target"}), ``variants`` (list of {"memory", and optionally
"substitute", "order", "subtask_goals", "goal", "demo_summary", "replaces_published"}). Other keys are kept in
``Task.metadata`` untouched.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.bddl import Problem, Region, parse_bddl
from lerobot_memobench.tasks.formula import LATCHES, Atom, Formula, atoms, parse_formula, rename

__all__ = [
    "BDDL_FILE",
    "LEVELS",
    "MEMORY_TYPES",
    "METADATA_FILE",
    "OPERATIONS",
    "Checkpoint",
    "Prompt",
    "Region",
    "Task",
    "Variant",
    "load_task",
]

MemoryType = Literal["temporal", "spatial", "object", "procedural"]
Operation = Literal["S", "U", "C"]
PromptKind = Literal["routine", "pick", "point", "highlight"]
Texts = tuple[str, str, str]

MEMORY_TYPES: tuple[MemoryType, ...] = get_args(MemoryType)
OPERATIONS: tuple[Operation, ...] = get_args(Operation)
LEVELS = ("coarse", "intermediate", "fine")
#: The level whose operation labels are evaluated (paper: intermediate).
DEFAULT_LEVEL = 1

BDDL_FILE = "task_config.bddl"
METADATA_FILE = "task_config.meta.json"

_PROMPT_WORDS: tuple[tuple[str, PromptKind], ...] = (
    ("picked up", "pick"),
    ("pointed", "point"),
    ("highlighted", "highlight"),
)
_ROUTINE_WORDS = ("procedure", "sequence", "routine", "follow", "step", "order")


@dataclass(frozen=True)
class Checkpoint:
    """A memory checkpoint.

    Attributes:
        goal: predicate that shows the event in the world.
        operations_by_level: label at the coarse, intermediate and fine level.
        language: what a memory should say after it, at the three levels.
    """

    goal: Formula
    operations_by_level: tuple[Operation, Operation, Operation]
    language: Texts

    @property
    def operation(self) -> Operation:
        """The label that is evaluated (intermediate level)."""
        return self.operations_by_level[DEFAULT_LEVEL]


@dataclass(frozen=True)
class Prompt:
    """What the prompt video shows: a routine, or ``target`` being picked up, pointed at or highlighted."""

    kind: PromptKind
    target: str | None = None


@dataclass(frozen=True)
class Variant:
    """Another admissible referent or order of a task, in the same scene and with the same instruction.

    Attributes:
        substitute: names replaced, all at once, in goal, checkpoint goals and prompt target.
        order: position k shows which checkpoint of the published task; its operation labels stay at their
            positions.
        languages: texts per position (coarse, intermediate, fine).
        goals: checkpoint goals per position in place of substituted and reordered ones.
        goal: goal in place of the substituted one.
        demo_summary: what the demonstration does.
        replaces_published: the published goal is looser than this variant's (it would accept another order),
            so variant 0 is not drawn.
    """

    languages: tuple[Texts, ...]
    substitute: dict[str, str] = field(default_factory=dict)
    order: tuple[int, ...] | None = None
    goals: tuple[Formula, ...] | None = None
    goal: Formula | None = None
    demo_summary: str = ""
    replaces_published: bool = False


@dataclass(frozen=True, eq=False)
class Task:
    """Everything the benchmark knows about a task. Do not change its dicts.

    Attributes:
        name: the folder's name.
        objects, fixtures: instance -> class, in the file's order.
        regions: full name (``<target>_<region>``) -> region.
        init: starting state; objects in regions are sampled, others rest on what they name.
        prompt: what the prompt video shows; None for temporal and spatial tasks.
        variants: the alternatives to the published task: ``variant(k)`` for k >= 1.
        variant_index: which variant this is.
        bddl_text, metadata: the files as read.
    """

    name: str
    memory_type: MemoryType
    family: str
    language: str
    objects: dict[str, str]
    fixtures: dict[str, str]
    regions: dict[str, Region]
    init: tuple[Atom, ...]
    objects_of_interest: tuple[str, ...]
    goal: Formula
    checkpoints: tuple[Checkpoint, ...]
    prompt: Prompt | None
    variants: tuple[Variant, ...]
    demo_summary: str
    folder: Path
    bddl_text: str = field(repr=False)
    metadata: dict[str, Any] = field(repr=False)
    variant_index: int = 0
    published: Task | None = field(default=None, repr=False)

    # Two tasks are the same when their files and variant are: pickled copies in worker processes stay equal
    # and hashable.
    def _key(self) -> tuple[str, str, str, int]:
        return self.name, self.bddl_text, json.dumps(self.metadata, sort_keys=True), self.variant_index

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Task) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash((self.name, self.bddl_text, self.variant_index))

    @property
    def operations(self) -> str:
        """Operation labels of the checkpoints at the evaluated level, e.g. "SUC"."""
        return "".join(checkpoint.operation for checkpoint in self.checkpoints)

    @property
    def num_variants(self) -> int:
        """Number of variants, the published one (0) included."""
        return 1 + len(self.variants)

    @property
    def random_variants(self) -> tuple[int, ...]:
        """The k to draw from for a random referent: all, without 0 where a stricter copy replaces it."""
        first = 1 if any(variant.replaces_published for variant in self.variants) else 0
        return tuple(range(first, self.num_variants))

    def variant(self, k: int) -> Task:
        """Return the task with goal, checkpoints, texts and prompt of variant ``k``; 0 is as published."""
        base = self.published or self
        if k == 0:
            return base
        if not 0 < k < self.num_variants:
            raise MemobenchError(f"{self.name} has variants 0 to {self.num_variants - 1}, not {k}; pass one of those")
        chosen = self.variants[k - 1]
        order = chosen.order or tuple(range(len(base.checkpoints)))
        goals = chosen.goals or tuple(rename(base.checkpoints[i].goal, chosen.substitute) for i in order)
        checkpoints = tuple(
            dataclasses.replace(checkpoint, goal=goal, language=language)
            for checkpoint, goal, language in zip(base.checkpoints, goals, chosen.languages, strict=True)
        )
        prompt = base.prompt
        if prompt is not None and prompt.target is not None:
            prompt = dataclasses.replace(prompt, target=chosen.substitute.get(prompt.target, prompt.target))
        return dataclasses.replace(
            base,
            goal=chosen.goal or rename(base.goal, chosen.substitute),
            checkpoints=checkpoints,
            prompt=prompt,
            demo_summary=chosen.demo_summary or base.demo_summary,
            variant_index=k,
            published=base,
        )


# --- loading ---


def load_task(folder: str | Path, require_metadata: bool = True) -> Task:
    """Load a task folder, of the catalogue or in the published format.

    ``require_metadata=False`` lets a folder without a metadata file load as a task without checkpoints; a
    metadata file that is there is always read in full. Where the metadata does not say it, the memory type is
    the parent folder's name if that is one of the four; else ``procedural`` or ``object`` for an instruction
    that speaks of a prompt or video (procedural when it also speaks of a procedure, sequence or steps),
    ``temporal`` when the goal holds a latch, and ``spatial`` otherwise.

    Raises ``MemobenchError`` that names file, place, what was found and what was expected.
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise MemobenchError(f"{folder} is not a folder, expected a task folder with {BDDL_FILE} and {METADATA_FILE}")
    text = _read(folder / BDDL_FILE, "the scene, instruction and goal in BDDL")
    problem = parse_bddl(text, folder / BDDL_FILE)
    path = folder / METADATA_FILE
    if require_metadata or path.exists():
        metadata = _Metadata(path, problem)
        data, checkpoints = metadata.data, metadata.checkpoints()
    else:
        metadata, data, checkpoints = None, {}, ()
    memory_type = _choice(data, "memory_type", MEMORY_TYPES, path) or _infer_memory_type(folder, problem)
    referent = _infer_referent(problem, checkpoints)
    return Task(
        name=folder.name,
        memory_type=cast(MemoryType, memory_type),
        family=_text(data, "family", path) or "unspecified",
        language=problem.language,
        objects=problem.objects,
        fixtures=problem.fixtures,
        regions=problem.regions,
        init=problem.init,
        objects_of_interest=problem.objects_of_interest,
        goal=problem.goal,
        checkpoints=checkpoints,
        prompt=metadata.prompt() if metadata and "prompt" in data else _infer_prompt(memory_type, problem, referent),
        variants=metadata.variants(len(checkpoints)) if metadata else (),
        demo_summary=_text(data, "demo_summary", path),
        folder=folder,
        bddl_text=text,
        metadata=data,
    )


def _read(path: Path, holds: str) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise MemobenchError(f"{path} is missing, expected a file that holds {holds}") from None
    except UnicodeDecodeError as error:
        raise MemobenchError(
            f"{path}: found a byte at offset {error.start} that is no UTF-8, expected UTF-8 text"
        ) from None
    except OSError as error:
        raise MemobenchError(f"{path} cannot be read ({error.strerror}), expected a file that holds {holds}") from None


def _infer_memory_type(folder: Path, problem: Problem) -> str:
    if folder.parent.name in MEMORY_TYPES:
        return folder.parent.name
    language = problem.language.lower()
    if "prompt" in language or "video" in language:
        words = language.replace("-", " ").split()
        return "procedural" if any(word.startswith(_ROUTINE_WORDS) for word in words) else "object"
    return "temporal" if any(atom.predicate in LATCHES for atom in atoms(problem.goal)) else "spatial"


def _infer_referent(problem: Problem, checkpoints: tuple[Checkpoint, ...]) -> str | None:
    """The object that the prompt is about, from the first checkpoint that names objects (else from the goal).

    Of its objects it is the first that could be mistaken for another of its class, else the first.
    """
    siblings = Counter(problem.objects.values())
    for formula in (*(checkpoint.goal for checkpoint in checkpoints), problem.goal):
        named = [arg for atom in atoms(formula) for arg in atom.args if arg in problem.objects]
        if named:
            return next((arg for arg in named if siblings[problem.objects[arg]] > 1), named[0])
    return None


def _infer_prompt(memory_type: str, problem: Problem, referent: str | None) -> Prompt | None:
    if memory_type not in ("object", "procedural"):
        return None
    language = problem.language.lower()
    kind: PromptKind = next((kind for words, kind in _PROMPT_WORDS if words in language), "routine")
    if kind == "routine" or referent is None:
        return Prompt("routine", referent if memory_type == "object" else None)
    return Prompt(kind, referent)


def _choice(data: Mapping[str, Any], key: str, allowed: tuple[str, ...], path: Path) -> str | None:
    value = data.get(key)
    if value is not None and value not in allowed:
        raise MemobenchError(f"{path}: found {key} = {_short(value)}, expected one of {', '.join(allowed)}")
    return value


def _text(data: Mapping[str, Any], key: str, path: Path | str) -> str:
    value = data.get(key, "")
    if not isinstance(value, str):
        raise MemobenchError(f"{path}: found {key} = {_short(value)}, expected text")
    return value


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _is_int(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


class _Metadata:
    """A metadata file and its checks; ``data`` is the file as read."""

    def __init__(self, path: Path, problem: Problem) -> None:
        self.path, self.problem = path, problem
        holds = (
            "'memory' (three texts per checkpoint: coarse, intermediate, fine), 'operating_type' (three "
            "labels per checkpoint: 0 Storage, 1 Update, 2 Compression), 'subtask_goals' (one formula per "
            "checkpoint) and 'key_frame' (-1 per checkpoint)"
        )
        text = _read(path, holds)
        try:
            data = json.loads(text, object_pairs_hook=self._pairs)
        except json.JSONDecodeError as error:
            raise MemobenchError(
                f"{path}, line {error.lineno}: found no valid JSON ({error.msg}), expected an object"
            ) from None
        except MemobenchError:
            raise
        except (ValueError, RecursionError) as error:
            raise MemobenchError(f"{path}: found JSON that cannot be read ({error}), expected an object") from None
        if not isinstance(data, dict):
            raise MemobenchError(f"{path}: found {_short(data)}, expected a JSON object that holds {holds}")
        missing = [key for key in ("memory", "operating_type", "subtask_goals") if key not in data]
        if missing:
            raise MemobenchError(f"{path} lacks {', '.join(map(repr, missing))}, expected an object that holds {holds}")
        self.data: dict[str, Any] = data

    def _pairs(self, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        for key in keys:
            if keys.count(key) > 1:
                raise MemobenchError(f"{self.path}: found the key {key!r} twice in one object, expected it once")
        return dict(pairs)

    def error(self, place: str, found: Any, expected: str) -> MemobenchError:
        return MemobenchError(f"{self.path}: found {place} = {_short(found)}, expected {expected}")

    def checkpoints(self) -> tuple[Checkpoint, ...]:
        goals = self.data["subtask_goals"]
        if not isinstance(goals, list) or not goals:
            raise self.error("subtask_goals", goals, "a list of at least one formula")
        labels = self.data["operating_type"]
        if not isinstance(labels, list) or len(labels) != len(goals):
            raise self.error("operating_type", labels, f"a list of {len(goals)} entries, one per subtask goal")
        for k, label in enumerate(labels):
            if not isinstance(label, list) or len(label) != 3 or not all(_is_int(x) and 0 <= x <= 2 for x in label):
                raise self.error(f"operating_type[{k}]", label, "three labels, each 0, 1 or 2")
        frames = self.data.get("key_frame", [-1] * len(goals))
        if not isinstance(frames, list) or len(frames) != len(goals) or not all(map(_is_int, frames)):
            raise self.error("key_frame", frames, f"a list of {len(goals)} integers, -1 where unknown")
        start = self.data.get("timestep_exec_start_idx", -1)
        if not _is_int(start) and not (isinstance(start, list) and all(map(_is_int, start))):
            raise self.error("timestep_exec_start_idx", start, "an integer or a list of integers")
        texts = self.texts(self.data["memory"], "memory", len(goals))
        return tuple(
            Checkpoint(
                self.formula(goal, f"subtask_goals[{k}]"),
                cast(tuple[Operation, Operation, Operation], tuple(OPERATIONS[x] for x in labels[k])),
                texts[k],
            )
            for k, goal in enumerate(goals)
        )

    def texts(self, value: Any, place: str, count: int) -> tuple[Texts, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise self.error(place, value, f"a list of {count} entries, one per subtask goal")
        for k, levels in enumerate(value):
            if (
                not isinstance(levels, list)
                or len(levels) != 3
                or not all(isinstance(text, str) and text.strip() for text in levels)
            ):
                raise self.error(f"{place}[{k}]", levels, "three texts: coarse, intermediate, fine")
        return tuple(cast(Texts, tuple(levels)) for levels in value)

    def formula(self, value: Any, place: str) -> Formula:
        where = f"{self.path}, {place}"
        return self.problem.resolve(parse_formula(value, where), where)

    def name(self, value: Any, place: str) -> str:
        kind = self.problem.entity_kind(value) if isinstance(value, str) else None
        if kind is None:
            hint = nearest(str(value), [*self.problem.objects, *self.problem.fixtures, *self.problem.regions])
            raise self.error(place, value, f"a name that the BDDL file declares, {hint}")
        return value

    def prompt(self) -> Prompt | None:
        value = self.data["prompt"]
        if value is None:
            return None
        if not isinstance(value, dict) or not set(value) <= {"kind", "target"}:
            raise self.error("prompt", value, 'null or {"kind": ..., "target": ...}')
        kind = value.get("kind")
        if kind not in get_args(PromptKind):
            raise self.error("prompt.kind", kind, f"one of {', '.join(get_args(PromptKind))}")
        target = value.get("target")
        if target is None and kind != "routine":
            raise self.error("prompt.target", target, f"the object that a prompt of kind {kind!r} shows")
        return Prompt(cast(PromptKind, kind), None if target is None else self.name(target, "prompt.target"))

    def variants(self, count: int) -> tuple[Variant, ...]:
        value = self.data.get("variants", [])
        if not isinstance(value, list):
            raise self.error("variants", value, "a list of objects")
        return tuple(self.one_variant(item, f"variants[{k}]", count) for k, item in enumerate(value))

    def one_variant(self, value: Any, place: str, count: int) -> Variant:
        keys = {
            "memory",
            "substitute",
            "order",
            "subtask_goals",
            "goal",
            "demo_summary",
            "replaces_published",
        }
        if not isinstance(value, dict) or not set(value) <= keys or "memory" not in value:
            raise self.error(place, value, f"an object with 'memory' and any of {', '.join(sorted(keys - {'memory'}))}")
        substitute = value.get("substitute", {})
        if not isinstance(substitute, dict):
            raise self.error(f"{place}.substitute", substitute, "an object of names to names")
        for old, new in substitute.items():
            self.name(old, f"{place}.substitute")
            self.name(new, f"{place}.substitute[{old!r}]")
        order = value.get("order")
        if order is not None and (
            not isinstance(order, list) or not all(map(_is_int, order)) or sorted(order) != list(range(count))
        ):
            raise self.error(f"{place}.order", order, f"each of 0 to {count - 1} once")
        goals = value.get("subtask_goals")
        if goals is not None and (not isinstance(goals, list) or len(goals) != count):
            raise self.error(f"{place}.subtask_goals", goals, f"a list of {count} formulas")
        if not isinstance(value.get("replaces_published", False), bool):
            raise self.error(f"{place}.replaces_published", value["replaces_published"], "true or false")
        # Substituted formulas are checked now, so that variant(k) cannot fail later.
        for k, goal in enumerate([rename(self.problem.goal, substitute), *self._renamed(substitute)]):
            self.problem.resolve(
                goal, f"{self.path}, {place}.substitute ({'goal' if k == 0 else f'checkpoint {k - 1}'})"
            )
        return Variant(
            languages=self.texts(value["memory"], f"{place}.memory", count),
            substitute=dict(substitute),
            order=None if order is None else tuple(order),
            goals=None
            if goals is None
            else tuple(self.formula(goal, f"{place}.subtask_goals[{k}]") for k, goal in enumerate(goals)),
            goal=None if value.get("goal") is None else self.formula(value["goal"], f"{place}.goal"),
            demo_summary=_text(value, "demo_summary", f"{self.path}, {place}"),
            replaces_published=value.get("replaces_published", False),
        )

    def _renamed(self, substitute: Mapping[str, str]) -> list[Formula]:
        return [
            rename(self.formula(g, f"subtask_goals[{k}]"), substitute) for k, g in enumerate(self.data["subtask_goals"])
        ]
