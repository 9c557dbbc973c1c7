"""A cell of the study: a training, its evaluation and its controls, each a command of the product that is run once.

The same call resumes a killed cell: a training from its last checkpoint, an evaluation from its log. A result of other
words than the grid's is an error.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_memobench.commands.command_line import parse_words
from lerobot_memobench.datasets.layout import INFO_FILE
from lerobot_memobench.errors import MemobenchError
from research.memory_study.commands import Cost, check_training, has_ended, kept_of, run_once, train_once
from research.memory_study.grid import POLICY, ROLLOUTS, SEALED, TRAINING, Grid, folder_name, word_of

CELLS = "cells"
"""Folder of all cells in the study's folder."""


@dataclass(frozen=True)
class Demonstrations:
    """The demonstrations of a suite."""

    grid: Grid
    suite: str
    out: Path
    workers: int = 1
    seed: int = 0

    @property
    def task_name(self) -> str:
        """Name in messages."""
        return f"demonstrations, {self.suite}"

    @property
    def folder(self) -> Path:
        """The dataset's folder."""
        return self.out / "demonstrations" / self.suite

    @property
    def _log(self) -> Path:
        return self.folder.with_suffix(".log")

    @property
    def _words(self) -> list[str]:
        suite = self.grid.suites[self.suite]
        tasks = ["--tasks", ",".join(suite.tasks)] if suite.tasks else []
        return ["memobench", "generate", *suite.demonstrations, *tasks, "--out", str(self.folder)]

    def run(self) -> None:
        """Generate them."""
        how = ["--workers", str(self.workers)]
        run_once(self._words, self._log, how=how, accept=(0, 1), proof=self.folder / INFO_FILE)

    def finished(self) -> bool:
        """Whether they are complete."""
        return ended_as(self._log, self._words)

    def failure(self) -> str | None:
        """Return None: the dataset's own log names the seeds that the expert did not solve."""
        return None


@dataclass(frozen=True)
class Cell:
    """A row on a suite with one training seed.

    Attributes:
        out: the study's folder.
        sealed: whether the sealed test is run too, if the row has it.
        at_once: cells that run at the same time, this one included.
        controlled: whether the controls of a row's last training seed are run too.
    """

    grid: Grid
    out: Path
    suite: str
    row: str
    seed: int
    sealed: bool = False
    at_once: int = 1
    controlled: bool = True

    @property
    def task_name(self) -> str:
        """Name in messages."""
        return f"{self.suite}, {self.row}"

    @property
    def name(self) -> str:
        """Path of the folder in the study's."""
        return f"{CELLS}/{self.suite}/{folder_name(self.row)}-{self.seed}"

    @property
    def folder(self) -> Path:
        """Folder of everything that the cell makes."""
        return self.out / self.name

    @property
    def policy(self) -> Path:
        """Folder of the training run."""
        return self.folder / POLICY

    @property
    def parts(self) -> list[str]:
        """The evaluation, the controls of a row's last training seed, and the sealed test if wanted, of its rows."""
        row = self.grid.rows[self.row]
        controls = row.controls if self.controlled and self.seed == row.seeds - 1 else ()
        sealed = self.sealed and row.sealed
        return [ROLLOUTS, *controls, *([SEALED] if sealed or has_ended(self.log(SEALED)) else [])]

    def evaluation(self, part: str) -> Path:
        """Return the folder of the evaluation or of a control."""
        return self.folder / folder_name(part)

    def log(self, part: str) -> Path:
        """Return the file of the output of the training or of an evaluation."""
        return self.folder / f"{folder_name(part)}.log"

    def run(self) -> None:
        """Train, then evaluate; skip commands that have ended."""
        train_once(self.training_words(), self.log(TRAINING), self.policy, at_once=self.at_once)
        for part in self.parts:
            run_once(self.evaluation_words(part), self.log(part), how=["resume=true"], at_once=self.at_once)

    def finished(self) -> bool:
        """Whether everything is done."""
        trained = self.done(TRAINING)
        evaluated = [part for part in self.parts if self.done(part)]
        if evaluated and not trained:
            raise MemobenchError(
                f"{self.evaluation(evaluated[0])} is of a policy that is missing in {self.folder}; remove this folder"
            )
        return trained and len(evaluated) == len(self.parts)

    def done(self, part: str) -> bool:
        """Return whether the training, the evaluation or a control has ended well."""
        words = self.training_words() if part == TRAINING else self.evaluation_words(part)
        return ended_as(self.log(part), words)

    def kept_names(self) -> list[str]:
        """Return the names of the training and of evaluations to keep (`research.kept`); [] without an evaluation."""
        parts = [part for part in self.parts if self.done(part)]
        return [f"{self.name}/{folder_name(part)}" for part in (TRAINING, *parts)] if parts else []

    def failure(self) -> str | None:
        """Return None: a failed command ends the study with its own message."""
        return None

    def check(self) -> None:
        """Refuse invalid words of its commands before any is run; datasets and policies need not exist."""
        from lerobot_memobench.rollouts.plan import read_settings, take_run_options

        words = self.training_words()
        check_training(words)
        for part in self.parts:
            rest = [word for word in self.evaluation_words(part)[2:] if not word.startswith(("env=", "policy="))]
            given = ["env=memobench", f"policy={word_of(words, 'policy')}", *rest]
            read_settings(take_run_options(parse_words(given))[1])

    def training_words(self) -> list[str]:
        """Return the command that trains its policy."""
        row = self.grid.rows[self.row]
        data = Demonstrations(self.grid, self.suite, self.out).folder
        policy = row.policy or self.grid.policy
        rest = [f"dataset={data}", f"seed={self.seed}", f"output_dir={self.policy}"]
        return ["lerobot", "train", *_last_of_each([*policy, *self.grid.training, *row.training]), *rest]

    def evaluation_words(self, part: str) -> list[str]:
        """Return the command that rolls its policy out."""
        suite = self.grid.suites[self.suite]
        own = self.grid.sealed if part == SEALED else self.grid.controls.get(part, [])
        words = [*self.grid.evaluation, *suite.evaluation, *suite.task_words, *own]
        command = ["lerobot", "eval", "env=memobench"]
        if part == SEALED:
            command = ["memobench", "test-sealed"]
            words = [word for word in words if not word.startswith("split=")]
        return [*command, f"policy={self.policy}", *_last_of_each(words), f"output_dir={self.evaluation(part)}"]

    def carded_words(self, part: str) -> list[str]:
        """Return the command on an evaluation's card; the sealed test runs another one."""
        words = self.evaluation_words(part)
        return ["lerobot", "eval", "env=memobench", *words[2:], f"split={SEALED}"] if part == SEALED else words

    def costs(self) -> dict[str, Cost]:
        """Return the cost of each part so far."""
        found = {part: kept_of(self.log(part)) for part in (TRAINING, *self.parts)}
        return {part: Cost(kept["wall_s"], kept["cpu_s"]) for part, kept in found.items() if kept}


def ended_as(log: Path, words: Sequence[str]) -> bool:
    """Return whether the command of a log has ended well."""
    kept = kept_of(log)
    if kept is None:
        return False
    differ = difference(kept["words"], words)
    if differ is not None:
        raise MemobenchError(
            f"{log.with_suffix('.json')} is of another command than the study's file asks for: only one of them has "
            f"{differ[:80]!r}; name another --out or --grid, or remove the command's results"
        )
    return kept["ended"]


def difference(first: Iterable[str], second: Iterable[str]) -> str | None:
    """Return the first word that only one of two commands has, None where they are equal in any folder."""
    one, other = _in_any_folder(first), _in_any_folder(second)
    if one == other:
        return None
    return next((word for word in (*one, *other) if (word in one) != (word in other)), "their order")


def _in_any_folder(words: Iterable[str]) -> list[str]:
    return [re.sub(r"(?s)^([\w.]+=)?.*/(?=(cells|demonstrations)/)", r"\1", word) for word in words]


def _last_of_each(words: Sequence[str]) -> list[str]:
    return list({word.partition("=")[0]: word for word in words}.values())
