"""``memobench agreement``: what annotation studies found."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.documents import Formats, show_report
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.files import write_file


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
    """Agreement of raters with one another and with the released operation labels."""
    from lerobot_memobench.evaluation.agreement import kappa as statistics
    from lerobot_memobench.evaluation.agreement.label_sheet import blank_sheet, read_labels
    from lerobot_memobench.paper import annotator_agreement

    if sum([labels is not None, paper, template is not None]) != 1:
        raise MemobenchError("expected one of LABELS.CSV, --paper and --template FILE")
    if template is not None:
        if template.exists():
            raise MemobenchError(f"--template {template} exists; name a new file, raters may have filled in that one")
        template.parent.mkdir(parents=True, exist_ok=True)
        console().print(str(write_file(template, blank_sheet(raters))), soft_wrap=True)
    elif labels is not None:
        show_report(statistics.report(statistics.study(read_labels(labels))), "agreement", format_, out)
    else:
        show_report(statistics.published_report(annotator_agreement()), "agreement_paper", format_, out)
