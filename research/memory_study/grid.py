"""The study as data: what is trained on what, and how it is evaluated; read from a YAML file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import draccus
import yaml

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.catalogue import resolve_tasks
from lerobot_memobench.tasks.task import MEMORY_TYPES, PUBLISHED

ROLLOUTS = "rollouts"
"""The evaluation itself, beside a cell's controls."""
SEALED = "sealed"
"""The evaluation on sealed seeds, which is run when all else is done, and counted."""
TRAINING, POLICY, AFTER = "training", "policy", "after"
SEED = r"seed=(\d+)"
"""How a training seed is named on the command line."""
RESERVED = (ROLLOUTS, SEALED, TRAINING, POLICY, AFTER)
"""How folders and files of a cell are called, or begin."""
PLACES = ("output_dir", "resume", "config_path")
"""Words of a command that say where it writes, and from where it goes on."""


def after(updates: int) -> str:
    """Return what the evaluation of the checkpoint of so many updates is called."""
    return f"{AFTER} {updates}"


@dataclass(frozen=True)
class Suite:
    """What is learned and rolled out.

    Attributes:
        demonstrations: words of ``memobench generate``. evaluation: of ``lerobot eval env=memobench``.
        tasks: tasks or memory types that are learned and rolled out; none: all.
        whole: whether the demonstrations are of all tasks, others' frames not drawn, and count in normalisation alone.
        ceilings: task -> best success without a memory, per cent: found (``research.necessity``), or exact.
    """

    demonstrations: list[str]
    evaluation: list[str] = field(default_factory=list)
    tasks: list[str] = field(default_factory=list)
    whole: bool = False
    ceilings: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Return which suite it is of: ``published`` or ``strict``."""
        return word_of(self.evaluation, "suite") or PUBLISHED

    @property
    def demonstration_words(self) -> list[str]:
        """Return the words of ``memobench generate``, the tasks among them unless the whole suite is shown."""
        return [*self.demonstrations, *(["--tasks", ",".join(self.tasks)] if self.tasks and not self.whole else [])]

    @property
    def task_words(self) -> list[str]:
        """Return the words of an evaluation of these tasks."""
        return [f"tasks={','.join(self.tasks)}"] if self.tasks else []

    @property
    def weight_words(self) -> list[str]:
        """Return the words of a training of ``memobench_mem`` that draws these tasks alone, of a whole suite's."""
        others = (kind for kind in MEMORY_TYPES if kind not in self.tasks)
        weights = dict.fromkeys(self.tasks, 1) | dict.fromkeys(others, 0)
        told = ", ".join(f"{name}: {weight}" for name, weight in weights.items())
        return [f"policy.task_weights={{{told}}}"] if self.tasks and self.whole else []


@dataclass(frozen=True)
class Row:
    """A policy of the table.

    Attributes:
        training: words of ``lerobot train``. evaluation: of ``lerobot eval env=memobench``.
        policy: which policy is trained, in words of ``lerobot train``; none: the grid's.
        seeds: training seeds, the first so many numbers. controls: names of those that its first one runs.
        after: updates after which each training is evaluated too, from the checkpoint that it kept then.
        privileged: whether it is given what the others are not, in training or in rollouts.
    """

    training: list[str] = field(default_factory=list)
    evaluation: list[str] = field(default_factory=list)
    policy: list[str] = field(default_factory=list)
    seeds: int = 1
    controls: list[str] = field(default_factory=list)
    after: list[int] = field(default_factory=list)
    privileged: bool = False


@dataclass(frozen=True)
class Tuning:
    """Updates and validation rollouts of each task by which a learning rate is chosen."""

    steps: int = 3000
    episodes: int = 3


@dataclass(frozen=True)
class Grid:
    """All rows, suites and seeds, and what they share."""

    policy: list[str]
    training: list[str]
    evaluation: list[str]
    suites: dict[str, Suite]
    rows: dict[str, Row]
    controls: dict[str, list[str]] = field(default_factory=dict)
    sealed: list[str] = field(default_factory=list)
    learning_rates: list[float] = field(default_factory=list)
    tuning: Tuning = field(default_factory=Tuning)

    def __post_init__(self) -> None:
        if not self.rows or not self.suites:
            raise MemobenchError("a study needs rows and suites, and has none; name some in its file")
        for what, names in (("rows", self.rows), ("controls", self.controls), ("suites", self.suites)):
            folders = [folder_name(name) for name in names]
            if twice := [name for name, folder in zip(names, folders, strict=True) if folders.count(folder) > 1]:
                raise MemobenchError(f"the {what} {', '.join(twice)} have one folder; rename one")
        for name in self.rows:
            if re.search(r"[|\n]|\(privileged\)$", name) or name in self.suites or re.fullmatch(SEED, name):
                raise MemobenchError(f"a row is called {name!r}, and --only or a table would not tell it; rename it")
        for name in self.controls:
            if folder_name(name).partition("_")[0] in RESERVED:
                raise MemobenchError(f"a control is called {name!r}, as something else of a cell; rename it")
        for name, suite in self.suites.items():
            self._check_suite(name, suite)
            known = resolve_tasks(suite.tasks or "all", suite.name)
            if strangers := [task for task in suite.ceilings if task not in known]:
                raise MemobenchError(f"suite {name!r} has a ceiling of {strangers[0]}; {nearest(strangers[0], known)}")
        for name, row in self.rows.items():
            self._check_row(name, row)

    def _check_suite(self, name: str, suite: Suite) -> None:
        told = suite.demonstrations
        shown = told[told.index("--suite") + 1] if "--suite" in told[:-1] else PUBLISHED
        if shown != suite.name:
            raise MemobenchError(
                f"suite {name!r} learns from suite {shown} and is rolled out on {suite.name}; name one"
            )
        if own := [word for word in told if word in ("--tasks", "--out", "--workers")]:
            raise MemobenchError(f"suite {name!r} has {own[0]} in demonstrations; the study says that itself")
        _refuse_words(f"suite {name!r}, evaluation", suite.evaluation, (*PLACES, "tasks", "policy"))

    def _check_row(self, name: str, row: Row) -> None:
        _refuse_words(f"row {name!r}, training", [*self.training, *row.training], (*PLACES, "seed", "dataset"))
        _refuse_words(
            f"row {name!r}, evaluation", row.evaluation, (*PLACES, "tasks", "policy", "seed", "episodes", "split")
        )
        for control in row.controls:
            if control not in self.controls:
                raise MemobenchError(f"row {name!r} names the control {control!r}; {nearest(control, self.controls)}")
        if row.seeds < 1:
            raise MemobenchError(f"row {name!r} has seeds: {row.seeds}; expected how many trainings, at least 1")
        words = [*self.training, *row.training]
        steps, every = (word_of(words, key) for key in ("steps", "save_freq"))
        for updates in row.after:
            if not steps or not every or updates < 1 or updates >= int(steps) or updates % int(every):
                raise MemobenchError(
                    f"row {name!r} has after: {updates}, and no checkpoint is kept then (steps={steps}, "
                    f"save_freq={every}); name a multiple of save_freq below steps"
                )

    def places(self) -> Iterator[tuple[str, str, int]]:
        """Yield suite, row and training seed of every cell: the first seeds of all rows before the second ones."""
        for seed in range(max(row.seeds for row in self.rows.values())):
            for suite in self.suites:
                yield from ((suite, name, seed) for name, row in self.rows.items() if seed < row.seeds)


def _refuse_words(where: str, words: Iterable[str], keys: Iterable[str]) -> None:
    """Refuse what the study says itself, or what would make a row another test than its neighbours."""
    if own := [key for key in keys if word_of(words, key) is not None]:
        raise MemobenchError(f"{where}: {own[0]}= is the study's to say, the same for all rows; leave it out")


def read_grid(path: Path) -> Grid:
    """Read a study's file.

    Raises:
        MemobenchError: it is none, or a row, control or field is not known.
    """
    try:
        with path.open(encoding="utf-8") as file:
            _check_keys(yaml.compose(file, yaml.SafeLoader))
            file.seek(0)
            return draccus.load(Grid, file)
    except MemobenchError:
        raise
    except FileNotFoundError:
        raise MemobenchError(f"there is no file {path}; name the study's by --grid") from None
    except Exception as error:  # draccus and PyYAML answer by their own kinds of error
        cause = error.__cause__
        if isinstance(cause, MemobenchError):
            raise cause from None
        raise MemobenchError(f"{path} is no study's file: {cause or error}") from None


def chosen(grid: Grid, only: Iterable[str]) -> list[tuple[str, str, int]]:
    """Return the cells that words name: a suite, a row or a seed (``strict``, ``bank``, ``seed=0``); by none all.

    Several words of one kind are alternatives; words of different kinds must all hold.

    Raises:
        MemobenchError: a word names nothing.
    """
    suites, rows, seeds = set[str](), set[str](), set[int]()
    for word in only:
        if word in grid.suites:
            suites.add(word)
        elif word in grid.rows:
            rows.add(word)
        elif match := re.fullmatch(SEED, word):
            seeds.add(int(match[1]))
        else:
            known = [*grid.suites, *grid.rows, "seed=0"]
            raise MemobenchError(f"--only {word!r} is no suite, row or seed of the study; {nearest(word, known)}")
    return [
        (suite, row, seed)
        for suite, row, seed in grid.places()
        if (not suites or suite in suites) and (not rows or row in rows) and (not seeds or seed in seeds)
    ]


def folder_name(name: str) -> str:
    """Return what the folders of a row, a control or a suite are called."""
    return re.sub(r"\W+", "_", name)


def word_of(words: Iterable[str], key: str) -> str | None:
    """Return the value of the last word ``key=value``; None where there is none."""
    return next((word.partition("=")[2] for word in reversed([*words]) if word.startswith(f"{key}=")), None)


def _check_keys(node: yaml.Node | None) -> None:
    """Refuse a key that stands twice: YAML would take the last, and say nothing."""
    if isinstance(node, yaml.MappingNode):
        keys = [key.value for key, _ in node.value]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise MemobenchError(f"{twice[0]!r} stands twice{node.start_mark}; rename one")
    for child in node.value if isinstance(node, yaml.CollectionNode) else ():
        for part in child if isinstance(child, tuple) else (child,):
            _check_keys(part)
