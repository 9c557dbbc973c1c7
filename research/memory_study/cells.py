"""A cell of the study: a training, its evaluation and its controls, each a command of the product, each done once.

Whatever kills a cell, the same call goes on with it: a training from its last checkpoint, an evaluation from its log.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lerobot_memobench.datasets.lerobot_format.layout import INFO_FILE
from lerobot_memobench.datasets.lerobot_format.reading import list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.report import keep_log
from lerobot_memobench.io import read_json, write_file
from lerobot_memobench.run.arguments import split_arguments
from research.learning.stages import Cost, check_training, ended, kept_of, run_once, train_once
from research.memory_study.grid import POLICY, ROLLOUTS, SEALED, TRAINING, Grid, after, folder_name, word_of

CELLS = "cells"
"""The folder of all cells in a study's."""


@dataclass(frozen=True)
class Demonstrations:
    """Those of a suite."""

    grid: Grid
    suite: str
    out: Path
    workers: int = 1
    seed: int = 0

    @property
    def task_name(self) -> str:
        """What it is called when its end is told."""
        return f"demonstrations, {self.suite}"

    @property
    def folder(self) -> Path:
        """The dataset's."""
        return self.out / "demonstrations" / self.suite

    @property
    def _log(self) -> Path:
        return self.out / "demonstrations" / f"{self.suite}.log"

    @property
    def _words(self) -> list[str]:
        told = self.grid.suites[self.suite].demonstration_words
        return ["memobench", "generate", *told, "--out", str(self.folder)]

    def run(self) -> None:
        """Generate them."""
        how = ["--workers", str(self.workers)]
        run_once(self._words, self._log, how=how, accept=(0, 1), proof=self.folder / INFO_FILE)

    def finished(self) -> bool:
        """Whether they are all there.

        Raises:
            MemobenchError: those that are there were made by other words than the grid's.
        """
        return ended_as(self._log, self._words)

    def keep(self, out: Path) -> None:
        """Keep in another study's folder by which words they were made."""
        if self.finished():
            _copy(self._log.with_suffix(".json"), replace(self, out=out)._log.with_suffix(".json"))

    def failure(self) -> str | None:
        """Nothing: a scene that the expert does not solve is told by its own log."""
        return None


@dataclass(frozen=True)
class Cell:
    """A row, in a suite, of a training seed.

    Attributes:
        out: the study's folder. tuned: a learning rate that is tried, for a short training; None: the row's own.
        sealed: whether the sealed test is run too. beside: cells that are run at once, this one included.
    """

    grid: Grid
    out: Path
    suite: str
    row: str
    seed: int
    tuned: float | None = None
    sealed: bool = False
    beside: int = 1

    @property
    def task_name(self) -> str:
        """What it is called when its end is told."""
        return f"{self.suite}, {self.row}" + ("" if self.tuned is None else f", learning rate {self.tuned:g}")

    @property
    def folder(self) -> Path:
        """Where everything of the cell is."""
        part = CELLS if self.tuned is None else f"tuning/{self.tuned:g}"
        return self.out / part / self.suite / f"{folder_name(self.row)}-{self.seed}"

    @property
    def policy(self) -> Path:
        """The training run's folder."""
        return self.folder / POLICY

    @property
    def parts(self) -> list[str]:
        """The evaluation, those of earlier checkpoints, and of a row's first training seed its controls."""
        if self.tuned is not None:
            return [ROLLOUTS]
        row = self.grid.rows[self.row]
        last = [SEALED] if self.sealed or ended(self.log(SEALED)) else []
        return [ROLLOUTS, *map(after, row.after), *(row.controls if self.seed == 0 else ()), *last]

    def evaluation(self, part: str) -> Path:
        """The folder of the evaluation or of a control."""
        return self.folder / folder_name(part)

    def log(self, part: str) -> Path:
        """Where the output of the training or of an evaluation goes."""
        return self.folder / f"{folder_name(part)}.log"

    def run(self) -> None:
        """Train, then evaluate, whatever of this is left to do.

        Raises:
            MemobenchError: a command failed, or what is there was made by other words than the grid's.
        """
        train_once(self.training_words(), self.log(TRAINING), self.policy, beside=self.beside)
        for part in self.parts:
            run_once(self.evaluation_words(part), self.log(part), how=["resume=true"], beside=self.beside)

    def finished(self) -> bool:
        """Whether nothing is left to do.

        Raises:
            MemobenchError: what is there was made by other words than the grid's, or evaluates a policy that is gone.
        """
        trained = self.done(TRAINING)
        there = [part for part in self.parts if self.done(part)]
        if there and not trained:
            raise MemobenchError(
                f"{self.evaluation(there[0])} is of a policy that is not in {self.folder} any more; remove this folder"
            )
        return trained and len(there) == len(self.parts)

    def done(self, part: str) -> bool:
        """Return whether the training, the evaluation or a control has ended well.

        Raises:
            MemobenchError: it was of other words than the grid's.
        """
        words = self.training_words() if part == TRAINING else self.evaluation_words(part)
        return ended_as(self.log(part), words)

    def keep(self, out: Path) -> list[Path]:
        """Keep of what is evaluated the logs, the cards and what they cost, compressed, in another study's folder.

        Tables and figures of that folder are those of this one. Return the folders of the logs.
        """
        kept = replace(self, out=out)
        parts = [part for part in self.parts if self.done(part)]
        for part in parts:
            keep_log(self.evaluation(part), kept.evaluation(part))
        for part in (TRAINING, *parts) if parts else ():
            if self.done(part):
                _copy(self.log(part).with_suffix(".json"), kept.log(part).with_suffix(".json"))
        rate = _rate_file(self.out, self.suite, self.row)
        if parts and rate.exists():
            _copy(rate, _rate_file(out, self.suite, self.row))
        return [kept.evaluation(part) for part in parts]

    def failure(self) -> str | None:
        """Nothing: what fails ends the study, and says why."""
        return None

    def check(self) -> None:
        """Refuse what its commands would, before any of them is run; datasets and policies need not be there.

        Raises:
            MemobenchError: an unknown setting or value, named with the nearest known one.
        """
        from lerobot_memobench.run.plan import take_run_options
        from lerobot_memobench.run.settings import read_settings

        words = self.training_words()
        check_training(words)
        for part in self.parts:
            told = [word for word in self.evaluation_words(part)[2:] if not word.startswith(("env=", "policy="))]
            given = ["env=memobench", f"policy={word_of(words, 'policy')}", *told]
            read_settings(take_run_options(split_arguments(given))[1])

    def training_words(self) -> list[str]:
        """Return the command that trains its policy."""
        row, suite = self.grid.rows[self.row], self.grid.suites[self.suite]
        data = Demonstrations(self.grid, self.suite, self.out).folder
        rate = self.tuned or chosen_rate(self.out, self.suite, self.row)
        tuned = [] if rate is None else [f"policy.optimizer_lr={rate:g}"]
        short = [] if self.tuned is None else [f"steps={self.grid.tuning.steps}"]
        policy = row.policy or [*self.grid.policy, *suite.weight_words]
        if row.policy and suite.tasks and suite.whole:
            policy = [*policy, *episode_words(data, suite.tasks)]
        told = [*policy, *self.grid.training, *row.training, *tuned, *short]
        rest = [f"dataset={data}", f"seed={self.seed}", f"output_dir={self.policy}"]
        return ["lerobot", "train", *_last_of_each(told), *rest]

    def evaluation_words(self, part: str) -> list[str]:
        """Return the command that rolls its policy out."""
        row, suite = self.grid.rows[self.row], self.grid.suites[self.suite]
        kept = {after(updates): self.policy / "checkpoints" / f"{updates:06}" for updates in row.after}
        own = self.grid.sealed if part == SEALED else self.grid.controls.get(part, [])
        short = [] if self.tuned is None else [f"episodes={self.grid.tuning.episodes}"]
        told = [*self.grid.evaluation, *suite.evaluation, *suite.task_words, *row.evaluation, *own, *short]
        if part == SEALED:
            command = ["memobench", "test-sealed"]
            told = [word for word in told if not word.startswith("split=")]
        else:
            command = ["lerobot", "eval", "env=memobench"]
        policy = f"policy={kept.get(part, self.policy)}"
        return [*command, policy, *_last_of_each(told), f"output_dir={self.evaluation(part)}"]

    def carded_words(self, part: str) -> list[str]:
        """Return the command that an evaluation's card tells; of the sealed test, what that runs."""
        words = self.evaluation_words(part)
        return ["lerobot", "eval", "env=memobench", *words[2:], f"split={SEALED}"] if part == SEALED else words

    def costs(self) -> dict[str, Cost]:
        """Return what each part has taken so far."""
        found = {part: kept_of(self.log(part)) for part in (TRAINING, *self.parts)}
        return {part: Cost(told["wall_s"], told["cpu_s"]) for part, told in found.items() if told}


def ended_as(log: Path, words: Sequence[str]) -> bool:
    """Return whether the command of a log has ended well.

    Raises:
        MemobenchError: it was of other words. In which folder a study is, and which episodes a dataset turned out to
            have of the tasks that are learned, is no difference.
    """
    told = kept_of(log)
    if told is None:
        return False
    differ = difference(told["words"], words)
    if differ is not None:
        raise MemobenchError(
            f"{log.with_suffix('.json')} is of another command than the study's file asks for: "
            f"{differ[:80]!r} stands in one of them alone; name another --out or "
            "--grid, or remove what the command has made"
        )
    return told["ended"]


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    write_file(target, source.read_text())


def difference(was: Iterable[str], wanted: Iterable[str]) -> str | None:
    """Return the first word that stands in one of two commands alone, None where they are alike in any folder."""
    one, other = _in_any_folder(was), _in_any_folder(wanted)
    if one == other:
        return None
    return next((word for word in (*one, *other) if (word in one) != (word in other)), "their order")


def _in_any_folder(words: Iterable[str]) -> list[str]:
    told = [word for word in words if not word.startswith("dataset.episodes=")]
    return [re.sub(r"(?s)^([\w.]+=)?.*/(?=(cells|tuning|demonstrations)/)", r"\1", word) for word in told]


def episode_words(data: Path, tasks: Sequence[str]) -> list[str]:
    """Return which demonstrations another's policy learns, which cannot draw tasks by weights; [] before there are any.

    Args:
        tasks: their names, or memory types.
    """
    if not data.is_dir():
        return []
    records = [(place.index, place.record) for place in list_episodes(data) if place.record is not None]
    chosen = [index for index, record in records if {record.task_name, record.memory_type} & {*tasks}]
    return [f"dataset.episodes={json.dumps(chosen, separators=(',', ':'))}"]


def _last_of_each(words: Sequence[str]) -> list[str]:
    """Let a later word take the place of an earlier one of its name."""
    return list({word.partition("=")[0]: word for word in words}.values())


# -- learning rates ---------------------------------------------------------------------------------------------------


def tuning(grid: Grid, out: Path, cells: Sequence[tuple[str, str, int]], beside: int = 1) -> list[Cell]:
    """Return the short trainings by which the learning rates of some cells' rows are chosen."""
    rows = dict.fromkeys((suite, row) for suite, row, _ in cells)
    return [Cell(grid, out, suite, row, 0, rate, beside=beside) for suite, row in rows for rate in grid.learning_rates]


def choose_rates(cells: Sequence[Cell]) -> dict[tuple[str, str], float]:
    """Choose the rate of each suite's rows whose average success on validation scenes is the highest; keep it.

    Of equal ones the middle of the list counts first, then what stands before it.

    Raises:
        MemobenchError: a cell was trained by another rate already.
    """
    grid, found = cells[0].grid, dict[tuple[str, str], dict[float, float]]()
    for cell in cells:
        report = read_json(cell.evaluation(ROLLOUTS) / "report.json", dict[str, object], "run the cell again")
        assert cell.tuned is not None
        found.setdefault((cell.suite, cell.row), {})[cell.tuned] = success_of(report)
    middle = grid.learning_rates[len(grid.learning_rates) // 2]
    rates = {}
    for (suite, row), of_rates in found.items():
        best = max(of_rates, key=lambda rate: (of_rates[rate], rate == middle))
        path, before = _rate_file(cells[0].out, suite, row), chosen_rate(cells[0].out, suite, row)
        trained = any((cells[0].out / "cells" / suite).glob(f"{folder_name(row)}-*/training.json"))
        if trained and before != best:
            raise MemobenchError(
                f"{suite}, {row} was trained with the learning rate {before}, and tuning chooses {best:g}; remove its "
                "cells, or the tuning's"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps({"chosen": best, "success": {f"{k:g}": v for k, v in of_rates.items()}}, indent=1))
        rates[suite, row] = best
    return rates


def success_of(report: dict[str, object]) -> float:
    """Return the average success of an evaluation's report, per cent."""
    average = report["average"]
    assert isinstance(average, dict)
    return float(average["SR"])


def chosen_rate(out: Path, suite: str, row: str) -> float | None:
    """Return the learning rate that tuning chose; None where none was done."""
    try:
        told = read_json(_rate_file(out, suite, row), dict[str, object], "remove it, and tune again")
    except FileNotFoundError:
        return None
    return float(str(told["chosen"]))


def _rate_file(out: Path, suite: str, row: str) -> Path:
    return out / "rates" / suite / f"{folder_name(row)}.json"
