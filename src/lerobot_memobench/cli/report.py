"""``memobench report``, ``compare`` and ``agreement``: what evaluations and annotation studies found, in figures."""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.documents.tables import Report


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
    from lerobot_memobench.evaluation.documents import formats
    from lerobot_memobench.evaluation.documents.report import build, render, write_documents, write_report
    from lerobot_memobench.evaluation.records.runs import read_runs

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


def compare(
    a: Annotated[str, typer.Argument(help="Folder of an evaluation, or NAME=FOLDER.", metavar="A")],
    b: Annotated[str, typer.Argument(help="The one that is compared with it.", metavar="B")],
    allow: Annotated[
        list[str] | None,
        typer.Option(help="A setting that is meant to differ, such as replan_steps; repeatable.", metavar="NAME"),
    ] = None,
    format_: Annotated[
        list[ReportFormat] | None,
        typer.Option("--format", help="table (default), markdown, latex or json; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for compare.md, compare.tex, compare.json and so on.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random signs.")] = 0,
    permutations: Annotated[int, typer.Option(min=100, help="Random signs where not all can be tried.")] = 10_000,
) -> None:
    """Compare two evaluations of the same episodes, pair by pair: McNemar for success, sign-flip for the rates."""
    from lerobot_memobench.evaluation.comparison import differences_report
    from lerobot_memobench.evaluation.comparison.differences import compare as compared
    from lerobot_memobench.evaluation.records.runs import read_runs

    first, second = read_runs([a, b])
    found = compared(first, second, allow=allow or (), seed=seed, permutations=permutations)
    _show(differences_report.report(found), "compare", format_, out)


def agreement(
    labels: Annotated[
        Path | None, typer.Argument(help="CSV: a row per template, a column per rater.", metavar="[LABELS.CSV]")
    ] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="Recompute the paper's study from what it publishes of it instead.")
    ] = False,
    template: Annotated[
        Path | None, typer.Option(help="Write a blank sheet of the 84 templates for a new study instead.")
    ] = None,
    raters: Annotated[int, typer.Option(min=2, help="Columns of the blank sheet.")] = 3,
    format_: Annotated[
        list[ReportFormat] | None,
        typer.Option("--format", help="table (default), markdown, latex or json; repeatable."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for agreement.md, agreement.json and so on.")] = None,
) -> None:
    """Agreement of raters with one another and with the released operation labels."""
    from lerobot_memobench.evaluation.agreement.label_sheet import blank_sheet, read_labels
    from lerobot_memobench.evaluation.agreement.published import published_report
    from lerobot_memobench.evaluation.agreement.report import report as study_report
    from lerobot_memobench.evaluation.agreement.study import study
    from lerobot_memobench.files import write_file
    from lerobot_memobench.paper import annotator_agreement

    if sum([labels is not None, paper, template is not None]) != 1:
        raise MemobenchError("expected one of LABELS.CSV, --paper and --template FILE")
    if template is not None:
        if template.exists():
            raise MemobenchError(f"--template {template} exists; name a new file, raters may have filled in that one")
        template.parent.mkdir(parents=True, exist_ok=True)
        console().print(str(write_file(template, blank_sheet(raters))), soft_wrap=True)
    elif labels is not None:
        _show(study_report(study(read_labels(labels))), "agreement", format_, out)
    else:
        _show(published_report(annotator_agreement()), "agreement_paper", format_, out)


ENDINGS = {
    ReportFormat.TABLE: "txt",
    ReportFormat.MARKDOWN: "md",
    ReportFormat.LATEX: "tex",
    ReportFormat.JSON: "json",
}


def _show(found: Report, name: str, formats_: list[ReportFormat] | None, out: Path | None) -> None:
    """Print a report in the formats wanted, or write it to a folder."""
    from lerobot_memobench.evaluation.documents import formats
    from lerobot_memobench.files import write_file

    wanted = list(dict.fromkeys(formats_ or [ReportFormat.TABLE]))
    if ReportFormat.CSV in wanted:
        raise MemobenchError(f"found --format csv; expected {', '.join(ENDINGS)}: what is told here is no one table")
    screen = console()
    for each in wanted:
        if each is ReportFormat.TABLE and out is None:
            screen.print(found.title, style="bold")
            screen.print(formats.terminal(found))
            continue
        write = {
            ReportFormat.TABLE: formats.text,
            ReportFormat.MARKDOWN: formats.markdown,
            ReportFormat.LATEX: formats.latex,
            ReportFormat.JSON: lambda report: json.dumps(report.data, indent=2) + "\n",
        }[each]
        if out is None:
            print(write(found), end="")
        else:
            out.mkdir(parents=True, exist_ok=True)
            screen.print(str(write_file(out / f"{name}.{ENDINGS[each]}", write(found))), soft_wrap=True)
