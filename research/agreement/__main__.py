"""``python -m research.agreement``: how far raters agree, with one another and with the released operation labels."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.report import Formats, show_report
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from research.agreement.published import annotator_agreement, published_report
from research.agreement.study import blank_sheet, read_labels, report, study
from research.command import run


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
    format_: Formats = None,
    out: Annotated[Path | None, typer.Option(help="Folder for agreement.md, agreement.json and so on.")] = None,
) -> None:
    """Tell how far raters agree. With one another and with the released operation labels."""

    if sum([labels is not None, paper, template is not None]) != 1:
        raise MemobenchError("expected one of LABELS.CSV, --paper and --template FILE")
    if template is not None:
        if template.exists():
            raise MemobenchError(f"--template {template} exists; name a new file, raters may have filled in that one")
        template.parent.mkdir(parents=True, exist_ok=True)
        console().print(str(write_file(template, blank_sheet(raters))), soft_wrap=True)
    elif labels is not None:
        show_report(report(study(read_labels(labels))), "agreement", format_, out)
    else:
        show_report(published_report(annotator_agreement()), "agreement_paper", format_, out)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("agreement", agreement, argv)


if __name__ == "__main__":
    sys.exit(main())
