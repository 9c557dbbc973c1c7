"""The grid of the study, read from a YAML file: suites, rows, training seeds and controls."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import draccus
import yaml

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.catalogue import resolve_tasks
from lerobot_memobench.tasks.task import PUBLISHED

ROLLOUTS = "rollouts"
"""The evaluation of a cell; its controls have names of their own."""
SEALED = "sealed"
"""The evaluation on sealed seeds: run once, last."""
TRAINING, POLICY = "training", "policy"
SEED = r"seed=(\d+)"
"""A training seed on the command line."""
GRID_FILE = Path(__file__).with_name("grid.yaml")
RESERVED = (ROLLOUTS, SEALED, TRAINING, POLICY)
"""Names of folders and files of a cell."""
PLACES = ("output_dir", "resume", "config_path")
"""Words of a command that name its folders."""


@dataclass(frozen=True)
class Suite:
    """Tasks, their demonstrations and their evaluation.

    Attributes:
        demonstrations: words of ``memobench generate``. evaluation: of ``lerobot eval env=memobench``.
        tasks: tasks or memory types to learn and roll out; none: all.
        ceilings: task -> best success without a memory, per cent (``research.necessity.adversaries``).
    """

    demonstrations: list[str]
    evaluation: list[str] = field(default_factory=list)
    tasks: list[str] = field(default_factory=list)
    ceilings: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """``published`` or ``strict``."""
        return word_of(self.evaluation, "suite") or PUBLISHED

    @property
    def task_words(self) -> list[str]:
        """Words of an evaluation of these tasks."""
        return [f"tasks={','.join(self.tasks)}"] if self.tasks else []


@dataclass(frozen=True)
class Row:
    """A policy of the table.

    Attributes:
        training: words of ``lerobot train``.
        policy: words of ``lerobot train`` that choose the policy; none: the grid's.
        seeds: number of training seeds, from 0 on. controls: names of controls that the last seed runs.
        sealed: whether the sealed test includes the row.
    """

    training: list[str] = field(default_factory=list)
    policy: list[str] = field(default_factory=list)
    seeds: int = 1
    controls: list[str] = field(default_factory=list)
    sealed: bool = False


@dataclass(frozen=True)
class Grid:
    """All rows and suites, and their shared words.

    Attributes:
        contrasts: name of a family -> pairs of a row and its reference; Holm's adjustment is within a family.
    """

    policy: list[str]
    training: list[str]
    evaluation: list[str]
    suites: dict[str, Suite]
    rows: dict[str, Row]
    controls: dict[str, list[str]] = field(default_factory=dict)
    sealed: list[str] = field(default_factory=list)
    contrasts: dict[str, list[tuple[str, str]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.rows or not self.suites:
            raise MemobenchError("the study's file has no rows or no suites; name at least one of each")
        for kind, names in (("rows", self.rows), ("controls", self.controls), ("suites", self.suites)):
            folders = [folder_name(name) for name in names]
            if same := [name for name, folder in zip(names, folders, strict=True) if folders.count(folder) > 1]:
                raise MemobenchError(f"the {kind} {', '.join(same)} have the same folder; rename one")
        for name in self.rows:
            if re.search(r"[|\n]", name) or name in self.suites or re.fullmatch(SEED, name):
                raise MemobenchError(
                    f"invalid name of a row: {name!r} is a suite, a seed, or breaks a table; rename it"
                )
        for name in self.controls:
            if folder_name(name) in RESERVED:
                raise MemobenchError(f"invalid name of a control: {name!r} is reserved; rename it")
        for name, suite in self.suites.items():
            self._check_suite(name, suite)
        for name, row in self.rows.items():
            self._check_row(name, row)
        for compared in (each for pairs in self.contrasts.values() for pair in pairs for each in pair):
            if compared not in self.rows:
                raise MemobenchError(f"contrasts name the row {compared!r}; {nearest(compared, self.rows)}")

    def _check_suite(self, name: str, suite: Suite) -> None:
        words = suite.demonstrations
        demonstrated = words[words.index("--suite") + 1] if "--suite" in words[:-1] else PUBLISHED
        if demonstrated != suite.name:
            raise MemobenchError(
                f"suite {name!r} has demonstrations of suite {demonstrated} and rollouts of {suite.name}; name the same"
            )
        if own := [word for word in words if word in ("--tasks", "--out", "--workers")]:
            raise MemobenchError(f"suite {name!r} has {own[0]} in demonstrations; the study sets it: leave it out")
        _refuse_words(f"suite {name!r}, evaluation", suite.evaluation, (*PLACES, "tasks", "policy"))
        known = resolve_tasks(",".join(suite.tasks) or "all", suite.name)
        if unknown := [task for task in suite.ceilings if task not in known]:
            raise MemobenchError(f"suite {name!r} has a ceiling of {unknown[0]}; {nearest(unknown[0], known)}")

    def _check_row(self, name: str, row: Row) -> None:
        _refuse_words(f"row {name!r}, training", [*self.training, *row.training], (*PLACES, "seed", "dataset"))
        for control in row.controls:
            if control not in self.controls:
                raise MemobenchError(f"row {name!r} names the control {control!r}; {nearest(control, self.controls)}")
        if row.seeds < 1:
            raise MemobenchError(f"row {name!r} has seeds: {row.seeds}; expected at least 1")

    def places(self) -> Iterator[tuple[str, str, int]]:
        """Yield suite, row and training seed of every cell: a suite's first seeds before its second ones."""
        for suite in self.suites:
            for seed in range(max(row.seeds for row in self.rows.values())):
                yield from ((suite, name, seed) for name, row in self.rows.items() if seed < row.seeds)


def _refuse_words(where: str, words: Iterable[str], keys: Iterable[str]) -> None:
    if own := [key for key in keys if word_of(words, key) is not None]:
        raise MemobenchError(f"{where}: {own[0]}= is set by the study, the same for all rows; leave it out")


def read_grid(path: Path) -> Grid:
    """Read a study's file."""
    try:
        with path.open(encoding="utf-8") as file:
            _check_keys(yaml.compose(file, yaml.SafeLoader))
            file.seek(0)
            return draccus.load(Grid, file)
    except MemobenchError:
        raise
    except FileNotFoundError:
        raise MemobenchError(f"there is no file {path}; name the study's file by --grid") from None
    except Exception as error:  # draccus and PyYAML have errors of their own
        cause = error.__cause__
        if isinstance(cause, MemobenchError):
            raise cause from None
        raise MemobenchError(f"invalid study's file {path}: {cause or error}") from None


def chosen(grid: Grid, only: Iterable[str]) -> list[tuple[str, str, int]]:
    """Return the cells that words name: a suite, a row or a seed (``strict``, ``bank``, ``seed=0``); by none all.

    Several words of one kind are alternatives; words of different kinds must all hold.
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
            raise MemobenchError(f"--only {word!r} is not a suite, row or seed of the study; {nearest(word, known)}")
    return [
        (suite, row, seed)
        for suite, row, seed in grid.places()
        if (not suites or suite in suites) and (not rows or row in rows) and (not seeds or seed in seeds)
    ]


def folder_name(name: str) -> str:
    """Return the name of the folder of a row, a control or a suite."""
    return re.sub(r"\W+", "_", name)


def word_of(words: Iterable[str], key: str) -> str | None:
    """Return the value of the last word ``key=value``; None where there is none."""
    return next((word.partition("=")[2] for word in reversed([*words]) if word.startswith(f"{key}=")), None)


def _check_keys(node: yaml.Node | None) -> None:
    if isinstance(node, yaml.MappingNode):
        keys = [key.value for key, _ in node.value]
        if twice := [key for key in keys if keys.count(key) > 1]:
            # YAML would silently take the last value.
            raise MemobenchError(f"{twice[0]!r} is given twice{node.start_mark}; rename one")
    for child in node.value if isinstance(node, yaml.CollectionNode) else ():
        for part in child if isinstance(child, tuple) else (child,):
            _check_keys(part)
