"""``python -m research.judge``: false positives and negatives of the judge on near misses.

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
from lerobot_memobench.tasks.task import SUITES
from research.command import run
from research.judge.cases import cases_of
from research.judge.stage import Stage, judge


class Row(NamedTuple):
    """Verdicts on one case of a task. ``right``: the verdict that the instruction asks for; ``given``: the judge's."""

    task: str
    suite: str
    kind: str
    right: bool
    given: bool


def rows_of(name: str) -> list[Row]:
    """Return the verdicts on a task's cases."""
    published = get_task(name)
    task = published.variant(published.random_variants[-1])  # the one that counts to the most
    stage = Stage(task)
    return [
        Row(name, task.suite, case.kind, case.accepted, case.is_accepted(task, judge(stage, recording, case.choice)))
        for case in cases_of(stage)
        for recording in [stage.record(case.moves)]
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
) -> None:
    """Judge right episodes and near misses of every task; print wrong verdicts by kind."""
    out.mkdir(parents=True, exist_ok=True)
    log = out / "cases.jsonl"
    rows = [Row(*json.loads(line)) for line in log.read_text().splitlines()] if log.is_file() else []
    names = tasks or task_names(suite=None)
    for name in [name for name in names if name not in {row.task for row in rows}]:
        verdicts = rows_of(name)
        rows += verdicts
        with log.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in verdicts)
    print(table([row for row in rows if row.task in names]))


if __name__ == "__main__":
    sys.exit(run("judge", judged))
