"""``memobench compare``: two evaluations of the same episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.documents import Formats, show_report


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
    """Compare two evaluations of the same episodes, pair by pair: McNemar for success, sign-flip for the rates."""
    from lerobot_memobench.evaluation.comparison import differences as comparison
    from lerobot_memobench.evaluation.records.runs import read_runs

    first, second = read_runs([a, b])
    found = comparison.compare(first, second, allow=allow or (), seed=seed, permutations=permutations)
    show_report(comparison.report(found), "compare", format_, out)
