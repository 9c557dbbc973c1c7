"""``python -m research.judge``: false positives and negatives of the judge on near misses, and surviving mutants.

Verdicts of a task are appended to ``cases.jsonl``; the same command continues an interrupted run.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import SUITES, Task
from research.command import run
from research.judge.mutants import Battery, is_not_shown, killer, mutants


class Row(NamedTuple):
    """Verdicts on one case of a task. ``right``: the verdict that the instruction asks for; ``given``: the judge's."""

    task: str
    suite: str
    kind: str
    right: bool
    given: bool


def variant_of(name: str) -> Task:
    """Return the variant of a task whose cases are judged: the last one, which counts to the most."""
    task = get_task(name)
    return task.variant(task.random_variants[-1])


def rows_of(battery: Battery) -> list[Row]:
    """Return the verdicts on a task's cases."""
    task = battery.task
    return [
        Row(task.name, task.suite, one.case.kind, one.case.accepted, one.case.is_accepted(task, one.verdict))
        for one in battery.judgements
    ]


def table(rows: Sequence[Row]) -> str:
    """Return wrong verdicts by kind and suite as Markdown; cases to accept come first."""
    kinds = dict(sorted({(row.kind, row.right) for row in rows}, key=lambda item: (not item[1], item[0])))
    lines = ["| case | right verdict | published: wrong | strict: wrong |", "|---|---|---:|---:|"]
    for kind, right in kinds.items():
        counts = " | ".join(_wrong([row for row in rows if (row.kind, row.suite) == (kind, suite)]) for suite in SUITES)
        lines.append(f"| {kind} | {'accept' if right else 'reject'} | {counts} |")
    for name, right in (("false negatives", True), ("false positives", False)):
        sums = " | ".join(_wrong([row for row in rows if (row.right, row.suite) == (right, suite)]) for suite in SUITES)
        lines.append(f"| **{name}** | | {sums} |")
    return "\n".join(lines)


def _wrong(rows: Sequence[Row]) -> str:
    return f"{sum(row.right != row.given for row in rows)} of {len(rows)}" if rows else "–"


def judged(
    out: Annotated[Path, typer.Option(help="Folder of the verdicts; the same command continues a run.")],
    tasks: Annotated[list[str] | None, typer.Option(help="Names of tasks; all of both suites if omitted.")] = None,
    with_mutants: Annotated[bool, typer.Option("--mutants", help="Test mutants of the judge on these tasks.")] = False,
) -> None:
    """Judge right episodes and near misses of every task; print wrong verdicts by kind."""
    out.mkdir(parents=True, exist_ok=True)
    log = out / "cases.jsonl"
    rows = [Row(*json.loads(line)) for line in log.read_text().splitlines()] if log.is_file() else []
    names, done = tasks or task_names(suite=None), {row.task for row in rows}
    batteries: list[Battery] = []
    for name in names:
        if name in done and not with_mutants:
            continue
        batteries.append(Battery(variant_of(name)))
        if name not in done:
            found = rows_of(batteries[-1])
            rows += found
            with log.open("a") as file:
                file.writelines(json.dumps(row) + "\n" for row in found)
    print(table([row for row in rows if row.task in names]))
    if with_mutants:
        batteries.sort(key=lambda one: one.task.suite, reverse=True)  # strict tasks kill most
        tried = [mutant for mutant in mutants() if not is_not_shown(mutant)]
        survivors = [mutant.name for mutant in tried if killer(mutant, batteries) is None]
        print(f"\nmutants killed: {len(tried) - len(survivors)} of {len(tried)}", *survivors, sep="\n")


if __name__ == "__main__":
    sys.exit(run("judge", judged))
