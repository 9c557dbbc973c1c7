"""Run an evaluation in this process: all of it, a part, or what an earlier run has left."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import POLICY, differences, has_log, read_log
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, read_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run, read_protocol
from lerobot_memobench.evaluation.report import REPORT_MARKDOWN, write_report
from lerobot_memobench.io import count_of, remove_drafts, write_file
from lerobot_memobench.jobs.processes import locked
from lerobot_memobench.policies.checkpoint import check_weights, portable_path
from lerobot_memobench.policies.memory_reads import MEMORY_READS
from lerobot_memobench.run.card import (
    card_of,
    extended,
    first_variant_mismatch,
    with_checkpoint,
    with_episodes,
    write_card,
)
from lerobot_memobench.run.evaluate import Advance, evaluate, lerobot_summary
from lerobot_memobench.run.machine import drawn_with
from lerobot_memobench.run.plan import Cell, EvaluationPlan
from lerobot_memobench.run.sealed import counted

VIDEOS, LEROBOT_INFO = "videos", "eval_info.json"
"""Folder of the videos, in that of the log; rates in the form of LeRobot's evaluation."""

Tell = Callable[[str], None]
"""Told what a user should know and what stops nothing."""


@dataclass(frozen=True)
class EvaluationReport:
    """What an evaluation found.

    Attributes:
        run: its rollouts, figures and notes; its folder holds the log, and the report's files.
        absent: (task, episode) of those that were asked for and are missing.
    """

    run: Run
    absent: Sequence[tuple[str, int]] = ()

    @property
    def page(self) -> Path:
        """The report as a file to read."""
        return self.run.folder / REPORT_MARKDOWN


def run_evaluation(
    plan: EvaluationPlan, tell: Tell, begin: Tell = lambda text: None, advance: Advance = lambda *news: None
) -> EvaluationReport | None:
    """Run what is missing, write report and card; return None for a part that holds no episode.

    Args:
        tell: told what matters and stops nothing, and how to go on when a run breaks off.
        begin: called with a line on the evaluation before it starts.
        advance: see `evaluate.Advance`.

    Raises:
        MemobenchError: the batch is none, the folder holds another evaluation, or weights are missing. Whatever
            LeRobot raises.
    """
    if plan.policy_path is not None:
        check_weights(plan.policy_path, plan.policy)
    with held(plan):
        if not plan.options.resume:
            check_new(plan.output)
            check_new(plan.log)
        card = card_of(plan)
        if plan.options.resume:
            card = resumed_card(plan.log, card, tell)
        cells = missing(plan)
        if cells:
            begin(_what_is_run(plan))
            return _run(plan, card, cells, tell, advance)
        return _finish(plan, card) if has_log(plan.log) else None


def _what_is_run(plan: EvaluationPlan) -> str:
    who = portable_path(plan.policy_path) if plan.policy_path else getattr(plan.policy, "type", "the policy")
    grid = plan.grid
    which = " with variants" if plan.environment.evidence else ""
    what = f"{count_of(len(grid.tasks), 'task')}{which}, {count_of(grid.runs, 'episode')} each"
    return f"evaluating {who} on {what}, into {plan.output}"


def _run(
    plan: EvaluationPlan, card: dict[str, Any], cells: Sequence[Cell], tell: Tell, advance: Advance
) -> EvaluationReport:
    """Run the batches that are left."""
    ended = False

    def begin() -> None:
        nonlocal card
        card = counted(plan, with_checkpoint(card, plan.policy_path), tell)
        write_card(plan.log, card)

    write_card(plan.log, card)
    try:
        evaluate(plan, cells, begin, advance)
        ended = True
        return _finish(plan, card)
    finally:
        if not ended and has_log(plan.log):
            tell(
                f"the episodes that ended are in {plan.log}; `memobench report {plan.log}` reports them, "
                f"`{plan.going_on}` goes on"
            )


def _finish(plan: EvaluationPlan, card: dict[str, Any]) -> EvaluationReport:
    """Write the report of the log, and what was found onto the card."""
    # A log of plain lerobot-eval holds whole batches: episodes beyond those asked for are no part of the report.
    limit = plan.grid.first + max(plan.grid.runs, card["protocol"]["episodes"])
    records = [record for record in read_log(plan.log) if record["episode"] < limit]
    write_card(plan.log, with_episodes(with_checkpoint(card, plan.policy_path), records))
    write_file(plan.output / LEROBOT_INFO, json.dumps(lerobot_summary(records, plan.grid.tasks), indent=2) + "\n")
    return EvaluationReport(write_report(plan.log, limit))


# --- going on: whether it is the same evaluation, which episodes are left, what is then run ---


def resumed_card(folder: Path, card: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Return the card for an evaluation that goes on with the one in ``folder``.

    Tasks and episodes may be others: those that are there stay. A folder without an evaluation is begun.

    Raises:
        MemobenchError: it is another evaluation: of another protocol, policy, or of other task files.
    """
    check_folder(folder)
    if not has_log(folder):
        return card
    found = differences(read_protocol(folder), {**card["protocol"], POLICY: card[POLICY]}, policy=True)
    if found:
        raise MemobenchError(
            f"{folder} holds an evaluation with another protocol ({'; '.join(found)}, there and now); repeat its "
            "settings to go on with it, or choose another output_dir="
        )
    if (problem := first_variant_mismatch(read_log(folder))) is not None:
        raise MemobenchError(
            f"the episodes in {folder} drew their variants otherwise ({problem}): an earlier version ran them, which "
            "did not draw in balance; go on with that version, or choose another output_dir="
        )
    if POLICY not in read_evaluation(folder):
        tell(f"note: {folder} has no result card: whether its episodes are this policy's cannot be checked")
        return card
    earlier = read_evaluation(folder, whole=True)
    edited = [name for name, value in card["task_files"].items() if earlier["task_files"].get(name, value) != value]
    if edited:
        raise MemobenchError(f"the files of {edited[0]} are not those that the episodes in {folder} were run with")
    for changed in _run_differences(earlier["runs"][-1], card["runs"][-1]):
        tell(f"note: the episodes in {folder} were run otherwise ({changed}, there and now); numbers may depend on it")
    return extended(earlier, card)


def _run_differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return in what the start of a run differs from that of an earlier one, on which numbers may depend."""
    found = []
    if earlier["batch_size"] != now["batch_size"]:
        found.append(f"batch_size: {earlier['batch_size']} and {now['batch_size']}")
    there, here = drawn_with(earlier), drawn_with(now)
    changed = [f"{key}: {there[key]} and {here[key]}" for key in here if there.get(key, here[key]) != here[key]]
    return found + changed[:1]


def missing(plan: EvaluationPlan) -> list[Cell]:
    """Return the batches that are to be run; a batch of which the log holds a part is run whole, but for that part."""
    options = plan.options
    done = logged(plan.log, plan.environment.referent) if options.resume or options.shard is not None else set()
    return plan.grid.missing(done, options.shard)


# --- the folder: whether it may be written to, held while a run lasts, left clean behind it ---


def check_new(folder: Path) -> None:
    """Refuse to mix an evaluation with an earlier one in the same folder."""
    if has_log(folder):
        raise MemobenchError(
            f"{folder} already holds an evaluation; choose another output_dir=, or go on with it by resume=true"
        )
    check_folder(folder)


def check_folder(folder: Path) -> None:
    """Refuse to write into what is no folder."""
    if folder.exists() and not folder.is_dir():
        raise MemobenchError(f"output_dir={folder} is a file; name a folder")


def logged(folder: Path, referent: str) -> set[tuple[str, int]]:
    """Return (task, episode) of the episodes in a folder's log, those included that could not be run."""
    if not has_log(folder):
        return set()
    records = read_log(folder)
    return {(record["task"], record["episode"]) for record in records if record.get("referent", "fixed") == referent}


@contextmanager
def held(plan: EvaluationPlan) -> Iterator[None]:
    """Hold the folders of an evaluation and of its log, see `made`.

    Drafts of a killed run are removed, and of a run that ends before its first episode the file that it made.
    """
    with ExitStack() as stack:
        for folder in {folder.absolute(): folder for folder in (plan.output, plan.log)}.values():
            stack.enter_context(made(folder))
        for folder in (plan.log, plan.log / VIDEOS, plan.log / MEMORY_READS):
            remove_drafts(folder)
        file = plan.log / EVALUATION_FILE
        there = file.exists()
        try:
            yield
        finally:
            if not there and not has_log(plan.log):
                file.unlink(missing_ok=True)


@contextmanager
def made(folder: Path, hold: bool = True) -> Iterator[None]:
    """Make a folder, and hold it, for as long as it is written to; of new ones nothing that is empty stays behind.

    Raises:
        MemobenchError: another run holds it, or it is a file.
    """
    check_folder(folder)
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder, folder) if hold else nullcontext():
        try:
            yield
        finally:
            for path in new:
                _remove_empty(path)


def _remove_empty(folder: Path) -> None:
    """Remove a folder and those below it, as far as they hold nothing."""
    if not folder.is_dir():
        return
    for child in sorted(folder.rglob("*"), reverse=True):
        if child.is_dir() and not any(child.iterdir()):
            child.rmdir()
    if not any(folder.iterdir()):
        folder.rmdir()
