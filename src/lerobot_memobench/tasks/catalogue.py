"""List and load the 30 published and 30 strict tasks, LIBERO's 130, and task folders in the published format.

A task folder holds ``task_config.bddl`` and ``task_config.meta.json``. Values missing from published metadata are
inferred from the folder name and the instruction. LIBERO's tasks have no checkpoints, prompt or variants, but 50
initial states each.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections import Counter
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.io import existing_spelling, files_below
from lerobot_memobench.tasks.bddl import Problem, parse_bddl
from lerobot_memobench.tasks.formula import LATCHES, atoms, to_lists
from lerobot_memobench.tasks.metadata import Metadata
from lerobot_memobench.tasks.task import (
    BDDL_FILE,
    LIBERO_SUITES,
    MEMORY_TYPES,
    METADATA_FILE,
    PUBLISHED,
    STRICT,
    SUITES,
    Checkpoint,
    LiberoSuite,
    MemoryType,
    Prompt,
    PromptKind,
    Task,
)
from lerobot_memobench.untrusted import refusing

#: <suite>/<memory type>/<task name>/{task_config.bddl, task_config.meta.json}; names are unique over all suites.
CATALOGUE_DIR = Path(__file__).parent / "catalogue"
LIBERO_FOLDER = Path(__file__).parent / "libero"
"""<suite>.zip: BDDL file and initial states of each task, in LIBERO's order; ``scripts/libero_suites.py`` writes it."""

ALL_SUITES: tuple[str, ...] = (*SUITES, *LIBERO_SUITES)
GROUPS: tuple[str, ...] = (*MEMORY_TYPES, *LIBERO_SUITES)
"""Groups of tasks in reports, and LeRobot's suites: memory types, and the suites of LIBERO."""

_PROMPT_WORDS: tuple[tuple[str, PromptKind], ...] = (
    ("picked up", "pick"),
    ("pointed", "point"),
    ("highlighted", "highlight"),
)
_ROUTINE_WORDS = ("procedure", "sequence", "routine", "follow", "step", "order")


# --- the catalogue ---


class _Entry(NamedTuple):
    suite: str
    group: str
    number: int
    folder: Path


@cache
def _entries() -> dict[str, _Entry]:
    """Task name -> entry, by suite, memory type (temporal, spatial, object, procedural), then by name."""
    entries: dict[str, _Entry] = {}
    for suite in SUITES:
        for memory_type in MEMORY_TYPES:
            for folder in sorted((CATALOGUE_DIR / suite / memory_type).iterdir()):
                if (folder / BDDL_FILE).is_file():
                    entries[folder.name] = _Entry(suite, memory_type, len(entries), folder)
    for libero in LIBERO_SUITES:
        archive = LIBERO_FOLDER / f"{libero}.zip"
        with zipfile.ZipFile(archive) as content:
            names = [file.removesuffix(".bddl") for file in content.namelist() if file.endswith(".bddl")]
        entries |= {name: _Entry(libero, libero, k, archive / name) for k, name in enumerate(names)}
    return entries


def _entry(name: str) -> _Entry:
    if name not in _entries():
        raise MemobenchError(f"found no task named {name!r} in the catalogue, {nearest(name, _entries())}")
    return _entries()[name]


def suite_of(name: str) -> str | None:
    """Return the suite of a catalogue task, None for an unknown name."""
    return _entries()[name].suite if name in _entries() else None


def group_of(name: str) -> str:
    """Return the memory type of a catalogue task, for a task of LIBERO its suite."""
    return _entry(name).group


def task_names(memory_type: str | None = None, suite: str | None = PUBLISHED) -> list[str]:
    """Return the names of a suite's tasks in catalogue order, optionally of one memory type only.

    ``suite=None`` selects the published suite and the strict one.
    """
    if suite is not None:
        check_choice("suite", suite, ALL_SUITES)
    if memory_type is not None:
        check_choice("memory type", memory_type, MEMORY_TYPES)
    suites = SUITES if suite is None else (suite,)
    return [
        name
        for name, entry in _entries().items()
        if entry.suite in suites and (memory_type is None or entry.group == memory_type)
    ]


def task_index(name: str) -> int:
    """Return the stable index of a task: its position in ``task_names(suite=None)``, or LIBERO's id."""
    return _entry(name).number


def libero_id(name: str) -> int | None:
    """Return LIBERO's id of a task, its index in its suite; None for a task that is not LIBERO's."""
    return task_index(name) if suite_of(name) in LIBERO_SUITES else None


def task_number(name: str) -> int:
    """Return the number of a task within its suite, in catalogue order; LIBERO's begin with 0."""
    suite = _entry(name).suite
    return task_names(suite=suite).index(name) + _first_number(suite)


def _first_number(suite: str) -> int:
    return 0 if suite in LIBERO_SUITES else 1


def task_folder(name: str) -> Path:
    """Return the folder of a catalogue task, for a task of LIBERO its place in an archive; `load_task` reads both."""
    return _entry(name).folder


@cache
def get_task(name: str) -> Task:
    """Return a catalogue task; raise `MemobenchError` with the nearest names for an unknown one."""
    entry = _entry(name)
    return _libero_task(entry) if entry.suite in LIBERO_SUITES else load_task(entry.folder)


# --- selection ---


def resolve_tasks(spec: str, suite: str = PUBLISHED) -> list[str]:
    """Return the task names selected by "all", memory types, names, numbers, or a comma-separated list of these.

    A number (`task_number`) or a range, such as ``12`` or ``3-7``, selects tasks of the suite. LIBERO's suites have no
    memory types. Names that contain commas are recognised. The given order is kept; repetitions are dropped.
    """
    known = task_names(suite=suite)
    text = spec
    for name in (name for name in _entries() if "," in name):  # its commas separate nothing
        text = text.replace(name, name.replace(",", "\0"))
    words = [word.replace("\0", ",").strip() for word in text.split(",")]
    if len(words) > 1 and "all" in words:
        raise MemobenchError(
            f"found 'all' with other entries among the tasks, {spec!r}; name either 'all' or the others"
        )
    types = MEMORY_TYPES if suite in SUITES else ()
    listing = "memobench tasks" if suite == PUBLISHED else f"memobench tasks --suite {suite}"
    chosen: list[str] = []
    for word in words:
        if not word:
            problem = "no name" if not spec.strip() else f"an empty entry in {spec!r}"
            raise MemobenchError(
                f"found {problem} among the tasks; expected 'all', or names, numbers or memory types separated by "
                "single commas"
            )
        if word == "all" or word in known:
            chosen += known if word == "all" else [word]
        elif word in types:
            chosen += task_names(word, suite)
        elif re.fullmatch(r"[\d -]*[\d-]", word):  # also a malformed number or range
            chosen += _numbered(word, known, suite, listing)
        elif word in ALL_SUITES:
            raise MemobenchError(f"{word!r} is a suite, no task; set suite={word}, or --suite {word}")
        elif (own := suite_of(word)) is not None:
            raise MemobenchError(f"{word!r} is a task of the {own} suite; set suite={own}, or --suite {own}")
        else:
            hint = nearest(word, ["all", *types, *known, *LIBERO_SUITES])
            raise MemobenchError(
                f"found {word!r} among the tasks, expected 'all', "
                f"{f'a memory type ({", ".join(types)}), ' if types else ''}or a task's name or number "
                f"(`{listing}` lists them), {hint}"
            )
    return list(dict.fromkeys(chosen))


def _numbered(word: str, names: list[str], suite: str, listing: str) -> list[str]:
    numbers, lowest = re.fullmatch(r"(\d+)(?:-(\d+))?", word), _first_number(suite)
    first, last = (-1, -1) if numbers is None else (int(numbers[1]), int(numbers[2] or numbers[1]))
    if not lowest <= first <= last < lowest + len(names):
        reversed_range = "the range is reversed; " if first > last else ""
        problem = "this is not a complete range; " if numbers is None else reversed_range
        raise MemobenchError(
            f"found {word} among the tasks; {problem}tasks of the {suite} suite are numbered {lowest} to "
            f"{lowest + len(names) - 1}, an example of a range is 3-7 (`{listing}` lists them)"
        )
    return names[first - lowest : last - lowest + 1]


def lerobots_choice(task: str | None, task_ids: Any, suite: str, tasks: str) -> tuple[tuple[str, ...], str]:
    """Return suites and ``tasks`` for LeRobot's settings ``task`` and ``task_ids``, next to ``suite`` and ``tasks``.

    ``task`` names suites of LIBERO, separated by commas, or is a value of ``tasks``; ``task_ids`` are LIBERO's, from 0.

    Raises:
        MemobenchError: both names of one setting are given, or ids with another suite than LIBERO's.
    """
    words = [] if task is None else [word.strip() for word in task.split(",")]
    suites = tuple(dict.fromkeys(words)) if any(word.startswith("libero") for word in words) else (suite,)
    if suites != (suite,):
        if memory_words := [word for word in words if word in (*SUITES, *MEMORY_TYPES)]:
            setting = "suite" if memory_words[0] in SUITES else "tasks"
            raise MemobenchError(
                f"task={task} names suites of LIBERO and {' and '.join(memory_words)}, of memory tasks; run them by "
                f"two commands, the second with {setting}={memory_words[0]}"
            )
        for name in suites:
            check_choice("task", name, LIBERO_SUITES)
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
    if not isinstance(task_ids, list) or not task_ids or not all(type(k) is int and k >= 0 for k in task_ids):
        raise MemobenchError(f"task_ids is {task_ids!r}; expected ids of LIBERO's tasks in a list, such as [0,1]")
    return suites, ",".join(map(str, task_ids))


# --- listing ---


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
        "gaps": [None if distance is None else distance._asdict() for distance in cue_to_use(task)],
        "state_dim": int(state_dim),
    }


def _by_class(instances: dict[str, str]) -> dict[str, list[str]]:
    by_class: dict[str, list[str]] = {}
    for instance, class_name in instances.items():
        by_class.setdefault(class_name, []).append(instance)
    return by_class


CUE_TO_USE_FILE = Path(__file__).with_name("cue_to_use.json")
"""Measured by ``scripts/cue_to_use.py`` on the scripted expert; ``docs/benchmark/gap.md`` defines it."""


class CueToUse(NamedTuple):
    """Control steps from the cue of a checkpoint to its use over the expert's episodes, without holds.

    ``held``: whether the first hold lies between cue and use.
    """

    least: int
    median: int
    most: int
    held: bool

    def __str__(self) -> str:
        return f"{self.median} + hold" if self.held else str(self.median)


def cue_in_prompt(task: Task, checkpoint: int) -> bool:
    """Return whether the demonstration prompt shows the answer to a checkpoint (0 is the first)."""
    # After a hiding, only the first choice, the drawer, depends on the prompt.
    return task.prompt is not None and (task.prompt.kind != "hide" or checkpoint == 0)


def cue_to_use(task: Task) -> tuple[CueToUse | None, ...]:
    """Return the steps of each checkpoint, () for a task that was not measured; None: nothing has to be remembered."""
    return tuple(
        None if row is None else CueToUse(*row, held=task.suite == STRICT and cue_in_prompt(task, k))
        for k, row in enumerate(_measured_cues().get(task.name, []))
    )


def longest_cue_to_use(task: Task) -> CueToUse | None:
    """Return the largest median of a task's checkpoints; None for a task without one or not measured."""
    known = [distance for distance in cue_to_use(task) if distance is not None]
    return max(known, key=lambda distance: (distance.held, distance.median), default=None)


@cache
def _measured_cues() -> dict[str, list[tuple[int, int, int] | None]]:
    rows: dict[str, list[tuple[int, int, int] | None]] = json.loads(CUE_TO_USE_FILE.read_text())
    return rows


# --- LIBERO's suites ---

NUM_STATES = 50  # initial states of each of LIBERO's tasks; episode i starts in state i
STEP_LIMITS: dict[LiberoSuite, int] = {
    "libero_spatial": 280,
    "libero_object": 280,
    "libero_goal": 300,
    "libero_10": 520,
    "libero_90": 400,
}
"""Control steps of an episode, those of LeRobot's LIBERO environment."""


def _libero_task(entry: _Entry) -> Task:
    """Return a LIBERO task, with the instruction that LIBERO and LeRobot derive from its name, not the file's."""
    name, suite = entry.folder.name, cast("LiberoSuite", entry.suite)
    text = _archived(entry, ".bddl").decode()
    words = name.split("_")
    scenes = [index for index, word in enumerate(words) if word.startswith("SCENE")]
    return Task(
        name=name,
        memory_type=suite,
        family=suite,
        language=" ".join(words[scenes[0] + 1 :] if name[0].isupper() and scenes else words),
        **parse_bddl(text, f"{entry.folder}.bddl").scene,
        folder=entry.folder,
        bddl_text=text,
        suite=suite,
    )


@lru_cache(maxsize=8)
def initial_states(name: str) -> NDArray[np.float64]:
    """Return the initial states of a LIBERO task, (50, 1 + nq + nv), read-only: time, positions and velocities."""
    states: NDArray[np.float64] = np.load(io.BytesIO(_archived(_entry(name), ".npy")), allow_pickle=False)
    states.flags.writeable = False
    return states


def _archived(entry: _Entry, suffix: str) -> bytes:
    with zipfile.ZipFile(entry.folder.parent) as archive:
        return archive.read(f"{entry.folder.name}{suffix}")


def check_states(suite: str, first: int, episodes: int) -> None:
    """Raise `MemobenchError` unless the tasks of a suite have the initial states of ``episodes`` from ``first`` on."""
    if not 0 <= first <= first + episodes <= NUM_STATES:
        raise MemobenchError(
            f"found the initial states {first} to {first + episodes - 1}, and tasks of {suite} have {NUM_STATES} "
            f"initial states, 0 to {NUM_STATES - 1}: ask for at most {NUM_STATES} episodes, and leave seed_base out"
        )


# --- task folders ---


def find_tasks(folder: str | Path) -> list[Path]:
    """Return the sorted task folders in a tree, the folder itself included.

    Raises:
        MemobenchError: the folder does not exist or contains no task, or two tasks have one name.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MemobenchError(f"{root} is not a folder; expected one that holds {BDDL_FILE}, or a tree of such folders")
    task_folders = [path.parent for path in files_below(root, BDDL_FILE) if path.name.lower() == BDDL_FILE]
    if not task_folders:
        raise MemobenchError(f"found no {BDDL_FILE} in {root} or below it; expected a task in the published format")
    by_name: dict[str, Path] = {}
    for path in task_folders:
        other = by_name.setdefault(path.resolve().name, path)  # "." has no name
        if other != path:
            raise MemobenchError(f"{other} and {path} hold tasks of one name; results are kept by name, so rename one")
    return task_folders


def load_task(folder: str | Path) -> Task:
    """Load a task folder.

    A memory type missing from the metadata is the parent folder's name if it is one of the four. Otherwise it is
    ``procedural`` or ``object`` for an instruction that mentions a prompt or video (``procedural`` if it also mentions
    a procedure, sequence or steps), ``temporal`` if the goal contains a latch, else ``spatial``.

    Raises:
        MemobenchError: with file, place, the value found and the value expected.
    """
    folder = Path(folder).resolve()
    if folder.parent.parent == LIBERO_FOLDER.resolve():  # a place in an archive, see `task_folder`
        return get_task(folder.name)
    if not folder.is_dir():
        raise MemobenchError(f"{folder} is not a folder, expected a task folder with {BDDL_FILE} and {METADATA_FILE}")
    bddl, path = existing_spelling(folder / BDDL_FILE), existing_spelling(folder / METADATA_FILE)
    expected = "expected the scene, instruction and goal in BDDL"
    with refusing(lambda why: MemobenchError(f"{bddl} cannot be read ({why}), {expected}"), bddl):
        text = bddl.read_text(encoding="utf-8-sig")
    problem = parse_bddl(text, bddl)
    metadata = Metadata(path, problem)
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
    """Return the prompt's object, from the first checkpoint that names objects, else from the goal."""
    siblings = Counter(problem.objects.values())
    for formula in (*(checkpoint.goal for checkpoint in checkpoints), problem.goal):
        objects = [arg for atom in atoms(formula) for arg in atom.args if arg in problem.objects]
        if objects:  # prefer one with siblings of its class, which could be confused
            return next((arg for arg in objects if siblings[problem.objects[arg]] > 1), objects[0])
    return None
