"""What the commands about evaluations have in common: options, and a report printed or written to a folder."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.documents.tables import Report
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


def given_runs(folders: list[str] | None, with_: Beside | None) -> tuple[list[Run], bool]:
    """Return the evaluations and whether the paper's figures are drawn; one of both is needed."""
    from lerobot_memobench.evaluation.documents.beside_paper import check_beside
    from lerobot_memobench.evaluation.records.runs import read_runs, unlike

    paper = with_ is Beside.PAPER
    if not folders and not paper:
        raise MemobenchError("there is nothing to draw; name folders of evaluations, or --with paper, or both")
    runs = read_runs(folders) if folders else []
    check_beside(runs, paper)
    for note in unlike({run.name: run.protocol for run in runs}) if runs else ():
        print(f"memobench: note: {note}", file=sys.stderr)
    return runs, paper


def show_report(report: Report, name: str, formats: Sequence[ReportFormat] | None, out: Path | None) -> None:
    """Print a report in the formats wanted, or write it to a folder as ``name`` with the formats' endings.

    Raises:
        MemobenchError: CSV is wanted.
    """
    wanted = list(dict.fromkeys(formats or [ReportFormat.TABLE]))
    if ReportFormat.CSV in wanted:
        raise MemobenchError(f"found --format csv; expected {', '.join(ENDINGS)}: what is told here is no one table")
    for each in wanted:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            path = write_file(out / f"{name}.{ENDINGS[each]}", _writer(each)(report))
            console().print(str(path), soft_wrap=True)
        elif each is ReportFormat.TABLE:
            _print_table(report)
        else:
            print(_writer(each)(report), end="")


def _print_table(report: Report) -> None:
    from lerobot_memobench.evaluation.documents.formats import terminal

    console().print(report.title, style="bold")
    console().print(terminal(report), crop=False)


def _writer(format_: ReportFormat) -> Callable[[Report], str]:
    from lerobot_memobench.evaluation.documents import formats

    return {
        ReportFormat.TABLE: formats.text,
        ReportFormat.MARKDOWN: formats.markdown,
        ReportFormat.LATEX: formats.latex,
        ReportFormat.JSON: lambda report: json.dumps(report.data, indent=2) + "\n",
    }[format_]
