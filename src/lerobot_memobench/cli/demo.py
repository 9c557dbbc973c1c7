"""``memobench demo``, what a memory is good for, and ``memobench doctor``, whether this machine can run it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from lerobot_memobench.cli.console import console, say, tell

if TYPE_CHECKING:
    from lerobot_memobench.doctor.examination import Finding, Status

COLOURS: dict[Status, str] = {"ok": "green", "warning": "yellow", "failed": "red"}


def demo(
    out: Annotated[Path, typer.Option(help="Folder of videos and report; an earlier demo there is replaced.")] = Path(
        "outputs/demo"
    ),
) -> int:
    """Evaluate the scripted expert on a task of each memory type. On one of them, trained policies as well, with a
    memory and without.
    """
    from rich.markdown import Markdown

    from lerobot_memobench.cli.evaluate import evaluate_here
    from lerobot_memobench.evaluation.report import REPORT_MARKDOWN
    from lerobot_memobench.run.demo import (
        CONTACT_SHEET,
        MEMORY_TABLE,
        MEMORY_VIDEO,
        compare_memories,
        demo_plan,
        has_policies,
        make_demo,
        memory_plan,
    )
    from lerobot_memobench.run.run import VIDEOS, run_evaluation

    def one_of_three(name: str, folder: Path) -> None:
        run_evaluation(memory_plan(name, folder), tell, say)

    make_demo(
        out,
        lambda folder: evaluate_here(demo_plan(folder), say_where=False),
        (lambda work, made: compare_memories(work, made, one_of_three)) if has_policies() else None,
    )
    if (out / MEMORY_TABLE).is_file():
        console().print(Markdown((out / MEMORY_TABLE).read_text()))
    say(f"report:  {out / REPORT_MARKDOWN}")
    say(f"videos:  {out / VIDEOS}")
    say(f"picture: {out / CONTACT_SHEET}")
    if (out / MEMORY_VIDEO).is_file():
        say(f"memory:  {out / MEMORY_VIDEO}")
    return 0


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> int:
    """Check that this machine can run the benchmark. What it cannot is told with how to mend it."""
    from lerobot_memobench.doctor.examination import examine, exit_status

    findings = examine()
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        console().print(finding_table(findings))
    return exit_status(findings)


def finding_table(findings: Sequence[Finding]) -> Table:
    """Return one row per finding, the fix under what it mends."""
    table = Table(header_style="bold", pad_edge=False, show_lines=False)
    for name in ("checked", "", "found"):
        table.add_column(name, overflow="fold")
    for finding in findings:
        found = Text(finding.detail)
        if finding.fix:
            found.append("\nfix: ", "bold").append(finding.fix)
        table.add_row(finding.what, Text(finding.status, COLOURS[finding.status]), found)
    return table
