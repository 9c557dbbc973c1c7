"""List and load the 30 published and 30 strict tasks, and task folders in the published format.

A task folder holds ``task_config.bddl`` and ``task_config.meta.json``. Values missing from published metadata are
inferred from the folder name and the instruction.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.io import files_below, spelled
from lerobot_memobench.tasks.bddl import Problem, parse_bddl
from lerobot_memobench.tasks.formula import LATCHES, atoms, to_lists
from lerobot_memobench.tasks.gap import gaps
from lerobot_memobench.tasks.metadata import Metadata, read_text
from lerobot_memobench.tasks.task import (
    BDDL_FILE,
    MEMORY_TYPES,
    METADATA_FILE,
    PUBLISHED,
    SUITES,
    Checkpoint,
    MemoryType,
    Prompt,
    PromptKind,
    Task,
)

#: <suite>/<memory type>/<task name>/{task_config.bddl, task_config.meta.json}; names are unique over both suites.
CATALOGUE_DIR = Path(__file__).parent / "catalogue"

TASK_NUMBERS = re.compile(r"(\d+)(?:-(\d+))?")
"""A task number, or an inclusive range of numbers."""

NUMERIC_ENTRY = re.compile(r"[\d -]*[\d-]")
"""An entry of digits, spaces and hyphens only; reported as a malformed number or range if it is not one."""

DEMO_TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
"""Short task of the demo: only the demonstration prompt shows which of three bowls is correct."""

_PROMPT_WORDS: tuple[tuple[str, PromptKind], ...] = (
    ("picked up", "pick"),
    ("pointed", "point"),
    ("highlighted", "highlight"),
)
_ROUTINE_WORDS = ("procedure", "sequence", "routine", "follow", "step", "order")


# --- the catalogue ---


@lru_cache(maxsize=1)
def _folders() -> dict[str, Path]:
    """Task name -> folder, by suite, memory type (temporal, spatial, object, procedural), then by name."""
    found: dict[str, Path] = {}
    for suite in SUITES:
        for memory_type in MEMORY_TYPES:
            for folder in sorted((CATALOGUE_DIR / suite / memory_type).iterdir(), key=lambda path: path.name):
                if (folder / BDDL_FILE).is_file():
                    found[folder.name] = folder
    return found


def suite_of(name: str) -> str | None:
    """Return the suite of a catalogue task, None for an unknown name."""
    return _folders()[name].parent.parent.name if name in _folders() else None


def check_suite(suite: str) -> str:
    """Return ``suite``; raise `MemobenchError` if it is unknown."""
    check_choice("suite", suite, SUITES)
    return suite


def task_names(memory_types: str | Iterable[str] | None = None, suite: str | None = PUBLISHED) -> list[str]:
    """Return the names of a suite's tasks in catalogue order, optionally of some memory types only.

    ``suite=None`` selects both suites, the published one first.
    """
    names = [name for name in _folders() if suite is None or suite_of(name) == check_suite(suite)]
    if memory_types is None:
        return names
    wanted = [memory_types] if isinstance(memory_types, str) else list(memory_types)
    for memory_type in wanted:
        if memory_type not in MEMORY_TYPES:
            raise MemobenchError(f"found the memory type {memory_type!r}, expected one of {', '.join(MEMORY_TYPES)}")
    return [name for name in names if _folders()[name].parent.name in wanted]


def task_index(name: str) -> int:
    """Return the stable index of a task: its position in ``task_names(suite=None)``."""
    return list(_folders()).index(task_folder(name).name)


def task_number(name: str) -> int:
    """Return the number of a task within its suite, in catalogue order from 1."""
    return task_names(suite=task_folder(name).parent.parent.name).index(name) + 1


def task_folder(name: str) -> Path:
    """Return the folder of a catalogue task; an unknown name raises `MemobenchError` with the nearest names."""
    if name not in _folders():
        raise MemobenchError(f"found no task named {name!r} in the catalogue, {nearest(name, _folders())}")
    return _folders()[name]


@cache
def get_task(name: str) -> Task:
    """Return a catalogue task; raises as `task_folder`."""
    return load_task(task_folder(name))


def resolve_tasks(spec: str | Iterable[str], suite: str = PUBLISHED) -> list[str]:
    """Return the task names selected by "all", memory types, names, numbers, or a comma-separated list of these.

    A number (`task_number`) or a range, such as ``12`` or ``3-7``, selects tasks of the suite. Names that contain
    commas are recognised. The given order is kept; repetitions are dropped.
    """
    check_suite(suite)
    if not isinstance(spec, str):
        spec = list(spec)
        _check_all_alone(spec)
        return list(dict.fromkeys(name for part in spec for name in resolve_tasks(part, suite)))
    pieces = spec.split(",")
    _check_all_alone(pieces)
    chosen: list[str] = []
    start = 0
    while start < len(pieces):
        for end in range(len(pieces), start, -1):
            word = ",".join(pieces[start:end]).strip()
            found = _expand(word, suite)
            if found:
                chosen += found
                start = end
                break
        else:
            word = pieces[start].strip()
            if not word:
                given = "no name" if not spec.strip() else f"an empty entry in {spec!r}"
                raise MemobenchError(
                    f"found {given} among the tasks; expected 'all', or names, numbers or memory types separated by "
                    "single commas"
                )
            hint = nearest(word, ["all", *MEMORY_TYPES, *task_names(suite=suite)])
            raise MemobenchError(
                f"found {word!r} among the tasks, expected 'all', a memory type ({', '.join(MEMORY_TYPES)}), "
                f"or a task's name or number (`memobench tasks` lists them), {hint}"
            )
    return list(dict.fromkeys(chosen))


def _check_all_alone(entries: list[str]) -> None:
    """Raise if "all" is combined with other entries."""
    if len(entries) > 1 and "all" in [entry.strip() for entry in entries]:
        raise MemobenchError(
            f"found 'all' with other entries among the tasks, {','.join(entries)!r}; name either 'all' or the others"
        )


def _expand(word: str, suite: str) -> list[str]:
    """Return the tasks selected by one entry, none for an unknown entry."""
    if word == "all" or word in MEMORY_TYPES:
        return task_names(None if word == "all" else word, suite)
    if NUMERIC_ENTRY.fullmatch(word) is not None:
        names, numbers = task_names(suite=suite), TASK_NUMBERS.fullmatch(word)
        first, last = (0, 0) if numbers is None else (int(numbers[1]), int(numbers[2] or numbers[1]))
        if not 1 <= first <= last <= len(names):
            reversed_range = "the range is reversed; " if first > last else ""
            problem = "this is not a complete range; " if numbers is None else reversed_range
            raise MemobenchError(
                f"found {word} among the tasks; {problem}tasks of the {suite} suite are numbered 1 to {len(names)}, "
                "an example of a range is 3-7 (`memobench tasks` lists them)"
            )
        return names[first - 1 : last]
    own = suite_of(word)
    if own not in (None, suite):
        raise MemobenchError(f"{word!r} is a task of the {own} suite; set suite={own}, or --suite {own}")
    return [] if own is None else [word]


def task_record(task: Task, state_dim: int) -> dict[str, Any]:
    """Return the entry of ``memobench tasks --json``; ``state_dim`` is 1 + nq + nv of the compiled model."""
    return {
        "name": task.name,
        "memory_type": task.memory_type,
        **({} if task.suite == PUBLISHED else {"suite": task.suite, "derived_from": task.derived_from}),
        "family": task.family,
        "language": task.language,
        "objects": _by_class(task.objects),
        "fixtures": _by_class(task.fixtures),
        "goal": to_lists(task.goal),
        "checkpoints": [
            {
                "goal": to_lists(checkpoint.goal),
                "operation": checkpoint.operation,
                "language": list(checkpoint.language),
            }
            for checkpoint in task.checkpoints
        ],
        "gaps": [None if gap is None else gap._asdict() for gap in gaps(task)],
        "state_dim": int(state_dim),
    }


def _by_class(instances: dict[str, str]) -> dict[str, list[str]]:
    grouped: dict[str, list[str]] = {}
    for instance, class_name in instances.items():
        grouped.setdefault(class_name, []).append(instance)
    return grouped


# --- task folders ---


def find_tasks(folder: str | Path) -> list[Path]:
    """Return the sorted task folders in a tree, the folder itself included.

    Raises:
        MemobenchError: the folder does not exist or contains no task, or two tasks have one name.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MemobenchError(f"{root} is not a folder; expected one that holds {BDDL_FILE}, or a tree of such folders")
    found = [path.parent for path in files_below(root, BDDL_FILE) if path.name.lower() == BDDL_FILE]
    if not found:
        raise MemobenchError(f"found no {BDDL_FILE} in {root} or below it; expected a task in the published format")
    named: dict[str, Path] = {}
    for place in found:
        other = named.setdefault(place.resolve().name, place)
        if other != place:
            raise MemobenchError(f"{other} and {place} hold tasks of one name; results are kept by name, so rename one")
    return found


def load_task(folder: str | Path, require_metadata: bool = True) -> Task:
    """Load a task folder.

    A memory type missing from the metadata is the parent folder's name if it is one of the four. Otherwise it is
    ``procedural`` or ``object`` for an instruction that mentions a prompt or video (``procedural`` if it also mentions
    a procedure, sequence or steps), ``temporal`` if the goal contains a latch, else ``spatial``.

    Args:
        folder: task folder.
        require_metadata: False loads a folder without a metadata file as a task without checkpoints.

    Raises:
        MemobenchError: with file, place, the value found and the value expected.
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise MemobenchError(f"{folder} is not a folder, expected a task folder with {BDDL_FILE} and {METADATA_FILE}")
    bddl, path = spelled(folder / BDDL_FILE), spelled(folder / METADATA_FILE)
    text = read_text(bddl, "the scene, instruction and goal in BDDL")
    problem = parse_bddl(text, bddl)
    metadata = Metadata(path, problem, present=require_metadata or path.exists())
    data, checkpoints = metadata.data, metadata.checkpoints()
    memory_type = data.get("memory_type") or _infer_memory_type(folder, problem)
    prompt = metadata.prompt(data["prompt"], "prompt") if "prompt" in data else None
    return Task(
        name=folder.name,
        memory_type=memory_type,
        family=data.get("family") or "unspecified",
        language=problem.language,
        objects=problem.objects,
        fixtures=problem.fixtures,
        regions=problem.regions,
        init=problem.init,
        objects_of_interest=problem.objects_of_interest,
        goal=problem.goal,
        checkpoints=checkpoints,
        prompt=prompt if "prompt" in data else _infer_prompt(memory_type, problem, checkpoints),
        variants=metadata.variants(),
        demo_summary=data.get("demo_summary", ""),
        folder=folder,
        bddl_text=text,
        metadata=dict(data),
        suite=data.get("suite", PUBLISHED),
        derived_from=data.get("derived_from") or None,
        drawn=data.get("drawn", False),
        spoilt_as=data.get("spoilt_as"),
    )


def _infer_memory_type(folder: Path, problem: Problem) -> MemoryType:
    for memory_type in MEMORY_TYPES:
        if folder.parent.name == memory_type:
            return memory_type
    language = problem.language.lower()
    if "prompt" in language or "video" in language:
        words = language.replace("-", " ").split()
        return "procedural" if any(word.startswith(_ROUTINE_WORDS) for word in words) else "object"
    return "temporal" if any(atom.predicate in LATCHES for atom in atoms(problem.goal)) else "spatial"


def _infer_prompt(memory_type: MemoryType, problem: Problem, checkpoints: tuple[Checkpoint, ...]) -> Prompt | None:
    if memory_type not in ("object", "procedural"):
        return None
    referent = _infer_referent(problem, checkpoints)
    language = problem.language.lower()
    kind: PromptKind = next((kind for words, kind in _PROMPT_WORDS if words in language), "routine")
    if kind == "routine" or referent is None:
        return Prompt("routine", referent if memory_type == "object" else None)
    return Prompt(kind, referent)


def _infer_referent(problem: Problem, checkpoints: tuple[Checkpoint, ...]) -> str | None:
    """Return the prompt's object, from the first checkpoint that names objects, else from the goal.

    Prefer the first object with siblings of its class, which could be confused, over the first object.
    """
    siblings = Counter(problem.objects.values())
    for formula in (*(checkpoint.goal for checkpoint in checkpoints), problem.goal):
        named = [arg for atom in atoms(formula) for arg in atom.args if arg in problem.objects]
        if named:
            return next((arg for arg in named if siblings[problem.objects[arg]] > 1), named[0])
    return None
