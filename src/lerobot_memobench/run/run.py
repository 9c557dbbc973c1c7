"""Run an evaluation in this process: all of it, a part, or the episodes that an earlier run left."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import Key, has_log, key_of, read_lines
from lerobot_memobench.envs.evaluation_file import (
    EVALUATION_FILE,
    POLICY,
    differences_of_parts,
    read_evaluation,
    write_evaluation,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.io import count_of, refuse_links, remove_drafts
from lerobot_memobench.jobs.processes import locked
from lerobot_memobench.policies.checkpoint import check_weights, portable_path
from lerobot_memobench.policies.memory_reads import MEMORY_READS
from lerobot_memobench.run.card import card_of, extended, with_checkpoint
from lerobot_memobench.run.evaluate import Advance, evaluate
from lerobot_memobench.run.plan import Cell, EvaluationPlan, Shard

VIDEOS = "videos"
"""Folder of the videos, in that of the log."""

Note = Callable[[str], None]
"""Called with a message for the user; the run continues."""


def run_evaluation(
    plan: EvaluationPlan, note: Note, begin: Note = lambda text: None, advance: Advance = lambda *news: None
) -> Run | None:
    """Run the missing episodes, write report and card; return None for a part that holds no episode.

    Args:
        note: called with notes, and with the command that resumes a run that breaks off.
        begin: called with a line on the evaluation before it starts.
        advance: see `evaluate.Advance`.

    Raises:
        MemobenchError: the folder holds another evaluation, or weights are missing. Any error of LeRobot.
    """
    if plan.policy_path is not None:
        check_weights(plan.policy_path, plan.policy)
    with held(plan):
        card = card_of(plan)
        if plan.options.resume:
            card = resumed_card(plan.log, card, note)
        else:
            check_new(plan.output)
            check_new(plan.log)
        for part in sorted(plan.output.parent.glob(Shard.FOLDERS)) if plan.options.shard is not None else ():
            resumed_card(part, card, lambda text: None)  # else the parts could not be merged
        cells = missing(plan)
        if cells:
            begin(_summary(plan))
            return _run(plan, card, cells, note, advance)
        if not has_log(plan.log):
            return None
        write_evaluation(plan.log, card)
        return write_report(plan.log)


def _summary(plan: EvaluationPlan) -> str:
    policy = portable_path(plan.policy_path) if plan.policy_path else plan.policy.type
    tasks = count_of(len(plan.grid.tasks), "task") + (" with variants" if plan.environment.evidence else "")
    return f"evaluating {policy} on {tasks}, {count_of(plan.grid.runs, 'episode')} each, into {plan.output}"


def _run(plan: EvaluationPlan, card: dict[str, Any], cells: Sequence[Cell], note: Note, advance: Advance) -> Run:
    """Run the batches that are left."""
    ended = False

    def begin() -> None:
        write_evaluation(plan.log, with_checkpoint(card, plan))

    write_evaluation(plan.log, card)
    try:
        evaluate(plan, cells, begin, advance)
        ended = True
        return write_report(plan.log)
    finally:
        if not ended and has_log(plan.log):
            note(
                f"the episodes that ended are in {plan.log}; report them: `memobench report {plan.log}`; "
                f"resume: `{plan.resuming_command}`"
            )


# --- resuming: whether it is the same evaluation, and which episodes are left ---


def resumed_card(folder: Path, card: dict[str, Any], note: Note) -> dict[str, Any]:
    """Return the card for an evaluation that resumes the one in ``folder``.

    Tasks and episodes may differ: finished ones are kept. Without an evaluation in the folder the card is returned.

    Raises:
        MemobenchError: it is another evaluation: of another protocol, policy, or of other task files.
    """
    check_folder(folder)
    if not has_log(folder):
        return card
    earlier = read_evaluation(folder)
    if found := differences_of_parts(earlier, card):
        raise MemobenchError(
            f"{folder} holds an evaluation with another protocol ({'; '.join(found)}, there and now); repeat its "
            "settings to resume it, or choose another output_dir="
        )
    if "runs" not in earlier:  # LeRobot's own command wrote it
        if not earlier[POLICY]:
            note(f"note: {folder} names no policy: whether its episodes are of this policy cannot be checked")
        return card
    earlier = read_evaluation(folder, whole=True)
    edited = [name for name, value in card["task_files"].items() if earlier["task_files"].get(name, value) != value]
    if edited:
        raise MemobenchError(f"the files of {edited[0]} differ from those that the episodes in {folder} were run with")
    for changed in _run_differences(earlier["runs"][-1], card["runs"][-1]):
        note(f"note: numbers may depend on a change since the episodes in {folder}: {changed}")
    return extended(earlier, card)


def _run_differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the differences of two starts on which numbers may depend: the batch size, and the first version."""
    sizes = {"batch_size": earlier["batch_size"]}, {"batch_size": now["batch_size"]}
    found = []
    for there, here in (sizes, (earlier["versions"], now["versions"])):
        changed = [f"{key} {there[key]}, now {here[key]}" for key in here if there.get(key, here[key]) != here[key]]
        found += changed[:1]
    return found


def missing(plan: EvaluationPlan) -> list[Cell]:
    """Return the batches that are to be run; a batch with a missing episode is run whole, its logged rows rest."""
    options = plan.options
    done = logged(plan.log) if options.resume or options.shard is not None else set()
    return plan.grid.missing(done, options.shard)


def logged(folder: Path) -> set[Key]:
    """Return the episodes in a folder's log, with those that could not be run."""
    return {*map(key_of, read_lines(folder))} if has_log(folder) else set()


# --- the folder of an evaluation ---


def check_new(folder: Path) -> None:
    """Refuse to mix an evaluation with an earlier one in the same folder."""
    if has_log(folder):
        raise MemobenchError(f"{folder} already holds an evaluation; choose another output_dir=, or add resume=true")
    check_folder(folder)


def check_folder(folder: Path) -> None:
    """Refuse a file in the place of a folder."""
    if folder.exists() and not folder.is_dir():
        raise MemobenchError(f"output_dir={folder} is a file; name a folder")


@contextmanager
def held(plan: EvaluationPlan) -> Iterator[None]:
    """Make and lock the folders of an evaluation and of its log, see `made`.

    Drafts of a killed run are removed. A run that ends before its first episode leaves no evaluation file.

    Raises:
        MemobenchError: another run writes there, or the folder of videos or memory reads is a link.
    """
    with ExitStack() as stack:
        for folder in {folder.absolute(): folder for folder in (plan.output, plan.log)}.values():
            stack.enter_context(made(folder))
        refuse_links(plan.log / VIDEOS, plan.log / MEMORY_READS)
        for folder in (plan.log, plan.log / VIDEOS, plan.log / MEMORY_READS):
            remove_drafts(folder)
        file = plan.log / EVALUATION_FILE
        existed = file.exists()
        try:
            yield
        finally:
            if not existed and not has_log(plan.log):
                file.unlink(missing_ok=True)


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Make a folder and lock it while it is written to; afterwards new folders that are empty are removed.

    Raises:
        MemobenchError: another run writes to it, or it is a file.
    """
    check_folder(folder)
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder, folder):
        try:
            yield
        finally:
            for path in new:
                for child in [*sorted(path.rglob("*"), reverse=True), path]:
                    if child.is_dir() and not any(child.iterdir()):
                        child.rmdir()
