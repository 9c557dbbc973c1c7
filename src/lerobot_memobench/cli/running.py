"""Run an evaluation in this process: all of it, a part, or what an earlier run has left."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_memobench.cli import preflight
from lerobot_memobench.cli.arguments import Translation
from lerobot_memobench.cli.evaluation import Evaluation, describe, logged, with_checkpoint
from lerobot_memobench.cli.loop import calm_output, steered
from lerobot_memobench.cli.plan import Range, task_names
from lerobot_memobench.engine.card import remove_card, with_episodes, write_card
from lerobot_memobench.envs.episode_log import has_log, read_episodes
from lerobot_memobench.evaluation.documents.report import REPORT_MARKDOWN
from lerobot_memobench.evaluation.records.protocol import POLICY, read_protocol
from lerobot_memobench.jobs.locking import locked

CONTINUED = "continued-{}"
"""Folder of LeRobot's own files of a run that goes on: it would write over those of the first."""


def run_evaluation(evaluation: Evaluation, run: Callable[[], int], say_where: bool = True) -> int:
    """Run what is missing, write report and card, print the report; return the exit status.

    Args:
        run: calls LeRobot with the evaluation's flags, as they are then.
        say_where: whether to print where the report is.
    """
    log, orders = evaluation.log, evaluation.orders
    if not orders.resume:
        preflight.check_output(evaluation.output)
        preflight.check_output(log)
    card = describe(evaluation)
    if orders.resume:
        card = preflight.check_resumed(log, card)
    ranges = missing(evaluation)
    if ranges == {}:
        if not has_log(log):
            print(f"part {orders.shard} holds no episode: there are fewer batches than parts")
            return 0
        return finish(evaluation, card, say_where)
    calm_output()
    output, status = evaluation.output, 1
    try:
        with folder_of(evaluation), steered(evaluation.seed, ranges):
            if card["protocol"]:
                write_card(log, card)
            go_on(evaluation, ranges)
            status = run()
            return finish(evaluation, card, say_where) if status == 0 else status
    finally:
        if status and has_log(log):
            print(
                f"the episodes that ended are in {log}; `memobench report {log}` reports them, the same command with "
                f"resume=true output_dir={output} goes on",
                file=sys.stderr,
            )


def missing(evaluation: Evaluation) -> dict[tuple[str, int], list[Range]] | None:
    """Return the runs that are to be made, in whole batches; None for all of them."""
    grid, orders = evaluation.grid, evaluation.orders
    if grid is None or not (orders.resume or orders.shard is not None):
        return None
    return grid.ranges(grid.missing(logged(evaluation.log, evaluation.environment.referent), orders.shard))


@contextmanager
def folder_of(evaluation: Evaluation) -> Iterator[None]:
    """Hold the evaluation's folder; a run that ends before its first episode leaves nothing in it."""
    log = evaluation.log
    new = [folder for folder in (evaluation.output, log) if not folder.exists()]
    log.mkdir(parents=True, exist_ok=True)
    try:
        with locked(log, log):
            preflight.remove_drafts(log)
            yield
    finally:
        if not has_log(log):
            remove_card(log)
            for folder in new:
                preflight.remove_empty(folder)


def go_on(evaluation: Evaluation, ranges: dict[tuple[str, int], list[Range]] | None) -> None:
    """Change LeRobot's flags to what is left of the evaluation."""
    if ranges is None or evaluation.grid is None:
        return
    translation: Translation = evaluation.translation
    names = task_names(evaluation.grid.places, ranges)
    if len(names) < len(evaluation.grid.places) and not translation.has("env.task_dir"):
        translation.set("env.task" if translation.has("env.task") else "env.tasks", ",".join(names))
    if has_log(evaluation.log):
        translation.set("env.resume", True)
        translation.set("output_dir", new_folder(evaluation.output))


def new_folder(output: Path) -> Path:
    """Return the first folder ``continued-k`` that is not there."""
    k = 1
    while (output / CONTINUED.format(k)).exists():
        k += 1
    return output / CONTINUED.format(k)


def finish(evaluation: Evaluation, card: dict[str, Any], say_where: bool) -> int:
    """Write and print the report of the log, write what was found onto the card."""
    log, grid = evaluation.log, evaluation.grid
    protocol = card["protocol"] or {k: v for k, v in read_protocol(log).items() if k != POLICY}
    # LeRobot runs whole batches: episodes beyond those asked for are no part of the report.
    limit = None if grid is None else grid.first + max(grid.runs, protocol["episodes"])
    print_report(log, limit)
    records = [record for record in read_episodes(log) if limit is None or record["episode"] < limit]
    card = with_checkpoint({**card, "protocol": protocol}, evaluation.translation.get("policy.path"))
    write_card(log, with_episodes(card, records))
    if say_where:
        print(f"report: {log / REPORT_MARKDOWN}")
    return 0


def print_report(folder: Path, episodes: int | None) -> None:
    """Write the report of the log in ``folder`` beside it and print its table."""
    from lerobot_memobench.cli.console import console
    from lerobot_memobench.evaluation.documents.report import failure_line, table, write_report

    summary, notes = write_report(folder, episodes)
    out = console()
    out.print()
    out.print(table(summary))
    out.print(failure_line(summary))
    for note in notes:
        out.print(f"note: {note}")
