"""The catalogue: the benchmark's 30 published and 30 strict tasks, as folders beside this module; loading a folder.

A folder holds ``task_config.bddl`` and ``task_config.meta.json``. The project's own and folders in the published format
are read alike; what the published metadata does not say is told from the folder and the instruction.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.tasks.bddl import Problem, parse_bddl
from lerobot_memobench.tasks.formula import LATCHES, atoms, to_lists
from lerobot_memobench.tasks.metadata import Metadata, read_text
from lerobot_memobench.tasks.task import (
    BDDL_FILE,
    MEMORY_TYPES,
    METADATA_FILE,
    PUBLISHED,
    STRICT_FAILURES,
    SUITES,
    Checkpoint,
    MemoryType,
    Prompt,
    PromptKind,
    Task,
)

#: <suite>/<memory type>/<task name>/{task_config.bddl, task_config.meta.json}; names are unique over both suites.
CATALOGUE_DIR = Path(__file__).parent / "catalogue"

NUMBERS = re.compile(r"(\d+)(?:-(\d+))?")
"""A task's number, or a range of them, both ends included."""

NUMERIC = re.compile(r"[\d -]*[\d-]")
"""What can be meant for nothing but these."""

BOWL = "put_the_butter_into_the_bowl_from_the_prompt_video"
"""The task that shows in little time what a memory is for: which of three bowls it is, the prompt alone tells."""

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
    """Return the suite of a task of the catalogue, None for a name that is not in it."""
    return _folders()[name].parent.parent.name if name in _folders() else None


def check_suite(suite: str) -> str:
    """Return the name of a suite; an unknown one is an error."""
    check_choice("suite", suite, SUITES)
    return suite


def task_names(memory_types: str | Iterable[str] | None = None, suite: str | None = PUBLISHED) -> list[str]:
    """Return the names of a suite's tasks, or of those of one or several memory types, in catalogue order.

    ``suite=None`` stands for both suites, the published one first.
    """
    there = [name for name in _folders() if suite is None or suite_of(name) == check_suite(suite)]
    if memory_types is None:
        return there
    wanted = [memory_types] if isinstance(memory_types, str) else list(memory_types)
    for memory_type in wanted:
        if memory_type not in MEMORY_TYPES:
            raise MemobenchError(f"found the memory type {memory_type!r}, expected one of {', '.join(MEMORY_TYPES)}")
    return [name for name in there if _folders()[name].parent.name in wanted]


def task_index(name: str) -> int:
    """Return the stable number of a task: its position in ``task_names(suite=None)``."""
    return list(_folders()).index(task_folder(name).name)


def task_number(name: str) -> int:
    """Return the short number of a task: its place in its own suite's catalogue order, from 1 on."""
    return task_names(suite=task_folder(name).parent.parent.name).index(name) + 1


def task_folder(name: str) -> Path:
    """Return the folder of a task of the catalogue; an unknown name is an error that tells the nearest known ones."""
    if name not in _folders():
        raise MemobenchError(f"found no task named {name!r} in the catalogue, {nearest(name, _folders())}")
    return _folders()[name]


@cache
def get_task(name: str) -> Task:
    """Return a task of the catalogue; errors as of `task_folder`."""
    return load_task(task_folder(name))


def resolve_tasks(spec: str | Iterable[str], suite: str = PUBLISHED) -> list[str]:
    """Return the task names of a suite meant by "all", memory types, names, or several of them separated by commas.

    A number (`task_number`) or a range, such as ``12`` or ``3-7``, stands for tasks of the suite. Names that hold
    commas themselves are recognised. The order given is kept and repetitions are dropped.
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
                given = "nothing" if not spec.strip() else f"an empty entry in {spec!r}"
                raise MemobenchError(
                    f"found {given} among the tasks; expected names, numbers or memory types with one comma between "
                    "two of them, or 'all'"
                )
            hint = nearest(word, ["all", *MEMORY_TYPES, *task_names(suite=suite)])
            raise MemobenchError(
                f"found {word!r} among the tasks, expected 'all', a memory type ({', '.join(MEMORY_TYPES)}), "
                f"or a task's name or number (`memobench tasks` lists them), {hint}"
            )
    return list(dict.fromkeys(chosen))


def _check_all_alone(entries: list[str]) -> None:
    """Refuse "all" beside others, of which one of the two cannot be meant."""
    if len(entries) > 1 and "all" in [entry.strip() for entry in entries]:
        raise MemobenchError(
            f"found 'all' beside others among the tasks, {','.join(entries)!r}; 'all' stands alone: name it, or the "
            "others"
        )


def _expand(word: str, suite: str) -> list[str]:
    """Return the tasks that a word means, none for an unknown one."""
    if word == "all" or word in MEMORY_TYPES:
        return task_names(None if word == "all" else word, suite)
    if NUMERIC.fullmatch(word) is not None:
        names, numbers = task_names(suite=suite), NUMBERS.fullmatch(word)
        first, last = (0, 0) if numbers is None else (int(numbers[1]), int(numbers[2] or numbers[1]))
        if not 1 <= first <= last <= len(names):
            backwards = "that range runs backwards; " if first > last else ""
            wrong = "that is no whole range; " if numbers is None else backwards
            raise MemobenchError(
                f"found {word} among the tasks; {wrong}those of the {suite} suite are numbered 1 to {len(names)}, "
                "a range is such as 3-7 (`memobench tasks` lists them)"
            )
        return names[first - 1 : last]
    own = suite_of(word)
    if own not in (None, suite):
        raise MemobenchError(f"{word!r} is a task of the {own} suite; say suite={own}, or --suite {own}")
    return [] if own is None else [word]


def task_record(task: Task, state_dim: int) -> dict[str, Any]:
    """Return the item of ``memobench tasks --json``; ``state_dim`` (1 + nq + nv) is the compiled model's."""
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
        "state_dim": int(state_dim),
    }


def _by_class(instances: dict[str, str]) -> dict[str, list[str]]:
    grouped: dict[str, list[str]] = {}
    for instance, class_name in instances.items():
        grouped.setdefault(class_name, []).append(instance)
    return grouped


# --- task folders, of the catalogue or in the published format ---


def find_tasks(folder: str | Path) -> list[Path]:
    """Return the task folders in a tree: the folder itself, or all below it that hold a task file, sorted.

    Raises:
        MemobenchError: there is no such folder, or no task in it.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MemobenchError(f"{root} is not a folder; expected one that holds {BDDL_FILE}, or a tree of such folders")
    found = sorted(path.parent for path in root.rglob(BDDL_FILE))
    if not found:
        raise MemobenchError(f"found no {BDDL_FILE} in {root} or below it; expected a task in the published format")
    return found


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
    text = read_text(folder / BDDL_FILE, "the scene, instruction and goal in BDDL")
    problem = parse_bddl(text, folder / BDDL_FILE)
    path = folder / METADATA_FILE
    read = require_metadata or path.exists()
    metadata = Metadata.read(path, problem) if read else Metadata(path, problem, {})
    checkpoints = metadata.checkpoints()
    memory_type = metadata.choice("memory_type", MEMORY_TYPES) or _infer_memory_type(folder, problem)
    stated = "prompt" in metadata.data
    return Task(
        name=folder.name,
        memory_type=memory_type,
        family=metadata.text("family") or "unspecified",
        language=problem.language,
        objects=problem.objects,
        fixtures=problem.fixtures,
        regions=problem.regions,
        init=problem.init,
        objects_of_interest=problem.objects_of_interest,
        goal=problem.goal,
        checkpoints=checkpoints,
        prompt=metadata.prompt() if stated else _infer_prompt(memory_type, problem, checkpoints),
        variants=metadata.variants(),
        demo_summary=metadata.text("demo_summary"),
        folder=folder,
        bddl_text=text,
        metadata=metadata.data,
        suite=metadata.choice("suite", SUITES, PUBLISHED),
        derived_from=metadata.text("derived_from") or None,
        drawn=metadata.flag("drawn"),
        spoilt_as=metadata.choice("spoilt_as", STRICT_FAILURES),
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
    """The object that the prompt is about, from the first checkpoint that names objects (else from the goal).

    Of its objects it is the first that could be mistaken for another of its class, else the first.
    """
    siblings = Counter(problem.objects.values())
    for formula in (*(checkpoint.goal for checkpoint in checkpoints), problem.goal):
        named = [arg for atom in atoms(formula) for arg in atom.args if arg in problem.objects]
        if named:
            return next((arg for arg in named if siblings[problem.objects[arg]] > 1), named[0])
    return None
