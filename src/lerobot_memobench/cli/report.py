"""``memobench report``, ``compare``, ``html``, ``merge``, ``rerun`` and ``controls``: what evaluations found."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.records.runs import Run


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


With = Annotated[Beside | None, typer.Option("--with", help="paper: stand the published figures beside.")]
Folders = Annotated[
    list[str] | None,
    typer.Argument(
        help="Folders that evaluations have written, or NAME=FOLDER; the same name for one policy at several replan "
        "intervals. None with --with paper: the paper's figure.",
        metavar="[DIR...]",
    ),
]
Formats = Annotated[
    list[ReportFormat] | None,
    typer.Option("--format", help="table (default), markdown, latex or json; repeatable."),
]

ENDINGS = {
    ReportFormat.TABLE: "txt",
    ReportFormat.MARKDOWN: "md",
    ReportFormat.LATEX: "tex",
    ReportFormat.JSON: "json",
}


Runs = Annotated[
    list[str],
    typer.Argument(
        help="Folders that evaluations have written, or NAME=FOLDER; the same name for one policy at several replan "
        "intervals.",
        metavar="DIR...",
    ),
]


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
    """Report SR, MSR, MUR and MCR of evaluations. Also prefix completion, failures and replan sweeps.

    report.json and report.md of each evaluation are written beside its log as well.
    """
    from lerobot_memobench.evaluation.documents.report import write_documents
    from lerobot_memobench.evaluation.records.runs import read_runs

    runs = read_runs(folders)
    wanted = list(dict.fromkeys(each.value for each in format_ or [ReportFormat.TABLE]))
    paper = with_ is Beside.PAPER
    _write_beside(runs)
    if out is None:
        _print_report(runs, wanted, paper)
        return
    for path in write_documents(runs, out, wanted, paper):
        console().print(str(path), soft_wrap=True)


def _write_beside(runs: Sequence[Run]) -> None:
    """Write each evaluation's own report beside its log, where that can be written."""
    from lerobot_memobench.evaluation.documents.report import write_report

    for run in runs:
        try:
            write_report(run.folder)
        except OSError as error:  # an archive that is only read
            reason = error.strerror or error
            print(f"memobench: {run.folder} cannot be written ({reason}); no report there", file=sys.stderr)


def _print_report(runs: Sequence[Run], formats: Sequence[str], paper: bool) -> None:
    from lerobot_memobench.evaluation.documents.formats import terminal
    from lerobot_memobench.evaluation.documents.report import build, render

    found = build(runs, paper)
    for name in formats:
        if name == ReportFormat.TABLE:
            console().print(terminal(found), crop=False)
        else:
            print(render(found, runs, name, paper), end="")


def compare(
    a: Annotated[str, typer.Argument(help="Folder of an evaluation, or NAME=FOLDER.", metavar="A")],
    b: Annotated[str, typer.Argument(help="The one that is compared with it.", metavar="B")],
    allow: Annotated[
        list[str] | None,
        typer.Option(help="A setting that is meant to differ, such as replan_steps; repeatable.", metavar="NAME"),
    ] = None,
    format_: Formats = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for compare.md, compare.tex, compare.json and so on.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random signs.")] = 0,
    permutations: Annotated[int, typer.Option(min=100, help="Random signs where not all can be tried.")] = 10_000,
) -> None:
    """Compare two evaluations of the same episodes, pair by pair. McNemar for success, sign-flip for the rates."""
    from lerobot_memobench.evaluation.comparison import differences_report
    from lerobot_memobench.evaluation.comparison.differences import compare as compared
    from lerobot_memobench.evaluation.records.runs import read_runs

    first, second = read_runs([a, b])
    found = compared(first, second, allow=allow or (), seed=seed, permutations=permutations)
    show_report(differences_report.report(found), "compare", format_, out)
