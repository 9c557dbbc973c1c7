"""List and load the 30 published and 30 strict tasks, LIBERO's 130, and task folders in the published format.

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
from lerobot_memobench.io import files_below, refusing, spelled
from lerobot_memobench.tasks.bddl import Problem, parse_bddl
from lerobot_memobench.tasks.formula import LATCHES, atoms, to_lists
from lerobot_memobench.tasks.gap import gaps
from lerobot_memobench.tasks.libero_suites import FOLDER as LIBERO_FOLDER
from lerobot_memobench.tasks.libero_suites import get_libero_task, libero_id, libero_suite_of, libero_tasks
from lerobot_memobench.tasks.metadata import Metadata
from lerobot_memobench.tasks.task import (
    BDDL_FILE,
    LIBERO_SUITES,
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

ALL_SUITES: tuple[str, ...] = (*SUITES, *LIBERO_SUITES)
GROUPS: tuple[str, ...] = (*MEMORY_TYPES, *LIBERO_SUITES)
"""Groups of tasks in reports, and LeRobot's suites: memory types, and the suites of LIBERO."""

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
    return _folders()[name].parent.parent.name if name in _folders() else libero_suite_of(name)


def group_of(name: str) -> str:
    """Return the memory type of a catalogue task, for a task of LIBERO its suite; raises as `task_folder`."""
    return libero_suite_of(name) or task_folder(name).parent.name


def check_suite(suite: str) -> str:
    """Return ``suite``; raise `MemobenchError` if it is unknown."""
    check_choice("suite", suite, ALL_SUITES)
    return suite


def task_names(memory_types: str | Iterable[str] | None = None, suite: str | None = PUBLISHED) -> list[str]:
    """Return the names of a suite's tasks in catalogue order, optionally of some memory types only.

    ``suite=None`` selects the published suite and the strict one.
    """
    if suite in LIBERO_SUITES:
        names = [*libero_tasks(suite)]
    else:
        names = [name for name in _folders() if suite is None or suite_of(name) == check_suite(suite)]
    if memory_types is None:
        return names
    wanted = [memory_types] if isinstance(memory_types, str) else list(memory_types)
    for memory_type in wanted:
        if memory_type not in MEMORY_TYPES:
            raise MemobenchError(f"found the memory type {memory_type!r}, expected one of {', '.join(MEMORY_TYPES)}")
    return [name for name in names if group_of(name) in wanted]


def task_index(name: str) -> int:
    """Return the stable index of a task: its position in ``task_names(suite=None)``, or LIBERO's id."""
    found = libero_id(name)
    return list(_folders()).index(task_folder(name).name) if found is None else found


def first_number(suite: str) -> int:
    """Return the number of a suite's first task: LIBERO's ids begin with 0."""
    return 0 if suite in LIBERO_SUITES else 1


def task_number(name: str) -> int:
    """Return the number of a task within its suite, in catalogue order."""
    suite = libero_suite_of(name) or task_folder(name).parent.parent.name
    return task_names(suite=suite).index(name) + first_number(suite)


def task_folder(name: str) -> Path:
    """Return the folder of a catalogue task, for a task of LIBERO its place in an archive; `load_task` reads both.

    Raises:
        MemobenchError: the name is unknown; the nearest names are given.
    """
    if libero_suite_of(name) is not None:
        return get_libero_task(name).folder
    if name not in _folders():
        known = [*_folders(), *(each for suite in LIBERO_SUITES for each in libero_tasks(suite))]
        raise MemobenchError(f"found no task named {name!r} in the catalogue, {nearest(name, known)}")
    return _folders()[name]


@cache
def get_task(name: str) -> Task:
    """Return a catalogue task; raises as `task_folder`."""
    return load_task(task_folder(name))


def resolve_tasks(spec: str | Iterable[str], suite: str = PUBLISHED) -> list[str]:
    """Return the task names selected by "all", memory types, names, numbers, or a comma-separated list of these.

    A number (`task_number`) or a range, such as ``12`` or ``3-7``, selects tasks of the suite. LIBERO's suites have no
    memory types. Names that contain commas are recognised. The given order is kept; repetitions are dropped.
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
            types = MEMORY_TYPES if suite in SUITES else ()
            hint = nearest(word, ["all", *types, *task_names(suite=suite), *LIBERO_SUITES])
            raise MemobenchError(
                f"found {word!r} among the tasks, expected 'all', "
                f"{f'a memory type ({", ".join(types)}), ' if types else ''}or a task's name or number "
                f"(`{_listing(suite)}` lists them), {hint}"
            )
    return list(dict.fromkeys(chosen))


def lerobots_choice(task: str | None, task_ids: Any, suite: str, tasks: str) -> tuple[tuple[str, ...], str]:
    """Return suites and ``tasks`` for LeRobot's settings ``task`` and ``task_ids``, next to ``suite`` and ``tasks``.

    Args:
        task: suites of LIBERO, separated by commas, or what ``tasks`` accepts.
        task_ids: LIBERO's ids of tasks, from 0, in each of the suites.

    Raises:
        MemobenchError: both names of one setting are given, or ids with another suite than LIBERO's.
    """
    words = [] if task is None else [word.strip() for word in task.split(",")]
    suites = tuple(dict.fromkeys(words)) if any(word.startswith("libero") for word in words) else (suite,)
    if suites != (suite,):
        if others := [word for word in words if word in (*SUITES, *MEMORY_TYPES)]:
            raise MemobenchError(
                f"task={task} names suites of LIBERO and {' and '.join(others)}, of memory tasks; run them by two "
                f"commands, the second with {f'suite={others[0]}' if others[0] in SUITES else f'tasks={others[0]}'}"
            )
        for each in suites:
            check_choice("task", each, LIBERO_SUITES)
        if suite not in (PUBLISHED, suites[0]):
            raise MemobenchError(f"task={task} and suite={suite} are both given; leave one of them out")
    elif words and {*words} != {suite}:
        if tasks != "all":
            raise MemobenchError(f"env.task={task} and env.tasks={tasks} are both given; remove env.task")
        tasks = str(task)
    if task_ids is None:
        return suites, tasks
    if tasks != "all":
        raise MemobenchError(f"task_ids={task_ids} and tasks={tasks} are both given; leave one of them out")
    if not {*suites} <= {*LIBERO_SUITES}:
        raise MemobenchError(f"task_ids={task_ids} are ids of LIBERO's suites, and suite={suite}; name tasks by tasks=")
    if not isinstance(task_ids, list) or not task_ids or not all(type(each) is int and each >= 0 for each in task_ids):
        raise MemobenchError(f"task_ids is {task_ids!r}; expected ids of LIBERO's tasks in a list, such as [0,1]")
    return suites, ",".join(map(str, task_ids))


def _check_all_alone(entries: list[str]) -> None:
    """Raise if "all" is combined with other entries."""
    if len(entries) > 1 and "all" in [entry.strip() for entry in entries]:
        raise MemobenchError(
            f"found 'all' with other entries among the tasks, {','.join(entries)!r}; name either 'all' or the others"
        )


def _expand(word: str, suite: str) -> list[str]:
    """Return the tasks selected by one entry, none for an unknown entry."""
    if word == "all" or (word in MEMORY_TYPES and suite in SUITES):
        return task_names(None if word == "all" else word, suite)
    if word in ALL_SUITES:
        raise MemobenchError(f"{word!r} is a suite, no task; set suite={word}, or --suite {word}")
    if NUMERIC_ENTRY.fullmatch(word) is not None:
        names, numbers = task_names(suite=suite), TASK_NUMBERS.fullmatch(word)
        lowest = first_number(suite)
        first, last = (-1, -1) if numbers is None else (int(numbers[1]), int(numbers[2] or numbers[1]))
        if not lowest <= first <= last < lowest + len(names):
            reversed_range = "the range is reversed; " if first > last else ""
            problem = "this is not a complete range; " if numbers is None else reversed_range
            raise MemobenchError(
                f"found {word} among the tasks; {problem}tasks of the {suite} suite are numbered {lowest} to "
                f"{lowest + len(names) - 1}, an example of a range is 3-7 (`{_listing(suite)}` lists them)"
            )
        return names[first - lowest : last - lowest + 1]
    own = suite_of(word)
    if own not in (None, suite):
        raise MemobenchError(f"{word!r} is a task of the {own} suite; set suite={own}, or --suite {own}")
    return [] if own is None else [word]


def _listing(suite: str) -> str:
    """Return the command that lists the tasks of a suite."""
    return "memobench tasks" if suite == PUBLISHED else f"memobench tasks --suite {suite}"


def task_record(task: Task, state_dim: int) -> dict[str, Any]:
    """Return the entry of ``memobench tasks --json``; ``state_dim`` is 1 + nq + nv of the compiled model."""
    return {
        "name": task.name,
        "memory_type": task.memory_type,
        **({"suite": task.suite, "derived_from": task.derived_from} if task.suite in SUITES[1:] else {}),
        **({"suite": task.suite, "id": task_index(task.name)} if task.suite in LIBERO_SUITES else {}),
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
    if folder.parent.parent == LIBERO_FOLDER.resolve():
        return get_libero_task(folder.name)
    if not folder.is_dir():
        raise MemobenchError(f"{folder} is not a folder, expected a task folder with {BDDL_FILE} and {METADATA_FILE}")
    bddl, path = spelled(folder / BDDL_FILE), spelled(folder / METADATA_FILE)
    expected = "expected the scene, instruction and goal in BDDL"
    with refusing(lambda why: MemobenchError(f"{bddl} cannot be read ({why}), {expected}"), bddl):
        text = bddl.read_text(encoding="utf-8-sig")
    problem = parse_bddl(text, bddl)
    metadata = Metadata(path if require_metadata or path.exists() else None, problem)
    data, checkpoints = metadata.data, metadata.checkpoints()
    memory_type = data.get("memory_type") or _infer_memory_type(folder, problem)
    inferred = "prompt" not in data
    return Task(
        name=folder.name,
        memory_type=memory_type,
        family=data.get("family") or "unspecified",
        language=problem.language,
        **problem.scene,
        checkpoints=checkpoints,
        prompt=_infer_prompt(memory_type, problem, checkpoints) if inferred else metadata.prompt(data["prompt"]),
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
