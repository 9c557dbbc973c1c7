"""The study as data: what is trained on what, and how it is evaluated; read from a YAML file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import draccus

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.task import MEMORY_TYPES


@dataclass(frozen=True)
class Suite:
    """What is learned and rolled out.

    Attributes:
        demonstrations: words of ``memobench generate``. evaluation: of ``lerobot eval env=memobench``.
        tasks: tasks or memory types that count; none: all of the demonstrations'.
        ceilings: task -> best success found without a memory, per cent (``research.necessity``).
    """

    demonstrations: list[str]
    evaluation: list[str] = field(default_factory=list)
    tasks: list[str] = field(default_factory=list)
    ceilings: dict[str, float] = field(default_factory=dict)

    @property
    def task_words(self) -> list[str]:
        """Return the words of an evaluation of these tasks."""
        return [f"tasks={','.join(self.tasks)}"] if self.tasks else []

    @property
    def weight_words(self) -> list[str]:
        """Return the words of a training of ``memobench_mem`` that draws these tasks alone."""
        others = (kind for kind in MEMORY_TYPES if kind not in self.tasks)
        weights = dict.fromkeys(self.tasks, 1) | dict.fromkeys(others, 0)
        told = ", ".join(f"{name}: {weight}" for name, weight in weights.items())
        return [f"policy.task_weights={{{told}}}"] if self.tasks else []


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
        for name, row in self.rows.items():
            for control in row.controls:
                if control not in self.controls:
                    raise MemobenchError(
                        f"row {name!r} names the control {control!r}; {nearest(control, self.controls)}"
                    )
            if row.seeds < 1:
                raise MemobenchError(f"row {name!r} has seeds: {row.seeds}; expected how many trainings, at least 1")
        folders = [folder_name(name) for name in self.rows]
        if len({*folders}) < len(folders):
            raise MemobenchError(f"two of the rows {', '.join(self.rows)} have one folder; rename one")

    def places(self) -> Iterator[tuple[str, str, int]]:
        """Yield suite, row and training seed of every cell: the first seeds of all rows before the second ones."""
        for seed in range(max(row.seeds for row in self.rows.values())):
            for suite in self.suites:
                yield from ((suite, name, seed) for name, row in self.rows.items() if seed < row.seeds)


def read_grid(path: Path) -> Grid:
    """Read a study's file.

    Raises:
        MemobenchError: it is none, or a row, control or field is not known.
    """
    try:
        with path.open(encoding="utf-8") as file:
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
        elif match := re.fullmatch(r"seed=(\d+)", word):
            seeds.add(int(match[1]))
        else:
            known = [*grid.suites, *grid.rows, "seed=0"]
            raise MemobenchError(f"--only {word!r} is no suite, row or seed of the study; {nearest(word, known)}")
    return [
        (suite, row, seed)
        for suite, row, seed in grid.places()
        if (not suites or suite in suites) and (not rows or row in rows) and (not seeds or seed in seeds)
    ]


def folder_name(row: str) -> str:
    """Return what a row's folders are called."""
    return re.sub(r"\W+", "_", row)
