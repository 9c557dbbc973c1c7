"""``memobench report``, ``compare`` and ``agreement``: what evaluations and annotation studies found, in figures."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console


class ReportFormat(StrEnum):
    """What a report is written as."""

    TABLE = "table"
    MARKDOWN = "markdown"
    CSV = "csv"
    LATEX = "latex"
    JSON = "json"


class Beside(StrEnum):
    """Whose figures stand beside."""

    PAPER = "paper"


Runs = Annotated[
    list[str],
    typer.Argument(
        help="Folders that evaluations have written, or NAME=FOLDER; the same name for one policy at several replan "
        "intervals.",
        metavar="DIR...",
    ),
]
With = Annotated[Beside | None, typer.Option("--with", help="paper: stand the published figures beside.")]


def report(
    folders: Runs,
    format_: Annotated[
        list[ReportFormat] | None,
        typer.Option("--format", help="table (default), markdown, csv, latex or json; repeatable."),
    ] = None,
    with_: With = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder that the report is written to, instead of being printed.")
    ] = None,
) -> None:
    """Report SR, MSR, MUR and MCR, prefix completion, failures and replan sweeps of evaluations.

    report.json and report.md of each evaluation are written beside its log as well.
    """
    from lerobot_memobench.evaluation import formats
    from lerobot_memobench.evaluation.report import build, render, write_documents, write_report
    from lerobot_memobench.evaluation.runs import read_runs

    runs = read_runs(folders)
    wanted = list(dict.fromkeys(each.value for each in format_ or [ReportFormat.TABLE]))
    paper = with_ is Beside.PAPER
    screen = console()
    for run in runs:
        try:
            write_report(run.folder)
        except OSError as error:  # an archive that is only read
            reason = error.strerror or error
            print(f"memobench: {run.folder} cannot be written ({reason}); no report there", file=sys.stderr)
    if out is not None:
        for path in write_documents(runs, out, wanted, paper):
            screen.print(str(path), soft_wrap=True)
        return
    found = build(runs, paper)
    for name in wanted:
        if name == ReportFormat.TABLE:
            screen.print(formats.terminal(found))
        else:
            print(render(found, runs, name, paper), end="")
