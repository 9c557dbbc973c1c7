"""``memobench controls …``: what the paper's controls tell of a memory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.io import write_file

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.documents.tables import Report

app = typer.Typer(
    help="Report the paper's controls. Oracle memory, shuffled memory, annotation granularity.", no_args_is_help=True
)


class Paper(StrEnum):
    """Whose figures are put beside ours."""

    PAPER = "paper"


Beside = Annotated[Paper | None, typer.Option("--with", help="paper: the published figures beside ours.")]
Out = Annotated[Path | None, typer.Option(help="Folder to write the table to, as Markdown, LaTeX and JSON.")]
Draws = Annotated[int, typer.Option(min=100, help="Bootstrap draws of the intervals.")]


@app.command()
def oracle(
    standard: Annotated[
        list[Path], typer.Argument(help="Evaluations of the policy as it is; one per replan interval.")
    ],
    oracle: Annotated[
        list[Path], typer.Option("--oracle", help="Evaluation of the policy with oracle memory text; repeatable.")
    ],
    beside: Beside = None,
    draws: Draws = 2000,
    out: Out = None,
) -> int:
    """Print which share of the gap to 100 % oracle memory closes: what a perfect memory would recover."""
    from lerobot_memobench.evaluation.comparison.control_rollouts import pairs_by_replan
    from lerobot_memobench.evaluation.comparison.oracle_memory import contrasts, oracle_report, published_contrasts
    from lerobot_memobench.paper import raw_tables

    pairs, notes = pairs_by_replan(standard, oracle, ignore=("oracle_memory",))
    found = {replan: contrasts(a, b, draws) for replan, (a, b) in pairs.items()}
    published = raw_tables()["oracle_memory"]
    paper = (published["replan_steps"], published_contrasts(published)) if beside else None
    return _show(oracle_report(found, paper), notes, "oracle", out)


@app.command()
def shuffled(
    normal: Annotated[Path, typer.Argument(help="Evaluation of the policy taught with subgoals in order.")],
    shuffled: Annotated[Path, typer.Argument(help="Evaluation of the policy taught with shuffled subgoals.")],
    beside: Beside = None,
    draws: Draws = 2000,
    out: Out = None,
) -> int:
    """Print how far rollouts come with normal and with shuffled memory, checkpoint by checkpoint."""
    from lerobot_memobench.evaluation.comparison.control_rollouts import pairs_by_replan
    from lerobot_memobench.evaluation.comparison.shuffled_memory import prefix_curves, shuffled_report
    from lerobot_memobench.paper import shuffled_control

    pairs, notes = pairs_by_replan([normal], [shuffled])
    found = {replan: prefix_curves(a, b, draws) for replan, (a, b) in pairs.items()}
    return _show(shuffled_report(found, shuffled_control() if beside else None), notes, "shuffled", out)


@app.command()
def granularity(
    coarse: Annotated[Path, typer.Option(help="Evaluation of the policy taught with coarse subgoals.")],
    intermediate: Annotated[Path, typer.Option(help="The same with intermediate subgoals.")],
    fine: Annotated[Path, typer.Option(help="The same with fine subgoals.")],
    beside: Beside = None,
    out: Out = None,
) -> int:
    """Print the metrics by the language level of the subgoals that a policy was taught with."""
    from lerobot_memobench.evaluation.comparison.control_rollouts import rollouts_by_level, with_labels_of_level
    from lerobot_memobench.evaluation.comparison.granularity import granularity_report

    levels, notes = rollouts_by_level(coarse, intermediate, fine)
    own = with_labels_of_level(levels)
    return _show(granularity_report(levels, own, paper=bool(beside)), notes, "granularity", out)


def _show(report: Report, notes: Sequence[str], name: str, out: Path | None) -> int:
    """Print a report, and write it where asked; return the exit status."""
    from lerobot_memobench.evaluation.documents.formats import latex, markdown, terminal

    noted = replace(report, sections=tuple(replace(each, notes=(*each.notes, *notes)) for each in report.sections))
    told = " ".join(f"{note}." for note in notes)
    captioned = [
        replace(each, tables=tuple(replace(t, note=f"{t.note} {told}") for t in each.tables))
        for each in report.sections
    ]
    screen = console()
    screen.print(terminal(noted), crop=False)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        data = {"title": report.title, "notes": list(notes), **report.data}
        contents = {
            "md": markdown(noted),
            "tex": latex(replace(report, sections=tuple(captioned))),
            "json": json.dumps(data, indent=1) + "\n",
        }
        for ending, content in contents.items():
            screen.print(str(write_file(out / f"{name}.{ending}", content)), soft_wrap=True)
    return 0
