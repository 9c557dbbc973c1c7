"""``memobench report``, ``compare``, ``merge`` and ``rerun``: results of evaluations."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console, note, say
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import count_of, write_file
from lerobot_memobench.jobs.processes import HeldError, locked

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.records import Run
    from lerobot_memobench.evaluation.tables import Report


class ReportFormat(StrEnum):
    """Formats of a report."""

    TABLE = "table"
    MARKDOWN = "markdown"
    CSV = "csv"
    LATEX = "latex"
    JSON = "json"


ENDINGS = {ReportFormat.TABLE: "txt", ReportFormat.MARKDOWN: "md", ReportFormat.LATEX: "tex", ReportFormat.JSON: "json"}

Formats = Annotated[
    list[ReportFormat] | None,
    typer.Option("--format", help="table (default), markdown, csv, latex or json; repeatable."),
]


def report(
    folders: Annotated[
        list[str],
        typer.Argument(
            help="Folders of evaluations, or NAME=FOLDER; the same name for one policy at several replan intervals.",
            metavar="DIR...",
        ),
    ],
    format_: Formats = None,
    out: Annotated[Path | None, typer.Option(help="Write the report to this folder instead of printing it.")] = None,
    html: Annotated[
        Path | None, typer.Option(help="Write a page for the browser with all videos to this folder.")
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Draw outcomes, gaps and replan intervals as PDF and PNG into this folder.")
    ] = None,
    task_dir: Annotated[
        Path | None, typer.Option(help="With --html: folder of your own tasks, for their texts.")
    ] = None,
) -> None:
    """Report SR, MSR, MUR and MCR of evaluations. Also prefix completion, failures, replan sweeps and controls.

    report.json and report.md are also written to the folder of each evaluation, unless its log is compressed.
    """
    from lerobot_memobench.evaluation.records import read_runs
    from lerobot_memobench.evaluation.report import evaluation_report

    runs = read_runs(folders)
    for run in runs:
        for each in run.evaluations:
            _write_next_to_log(each)
    show_report(evaluation_report(runs), "report", format_, out)
    if figures is not None:
        from lerobot_memobench.evaluation.plots import draw_figures

        for path in draw_figures(runs, figures):
            say(path)
    if html is not None:
        from lerobot_memobench.evaluation.html import write_html

        written = write_html(folders, html, task_dir)
        for line in written.notes:
            say(f"note: {line}")
        say(f"{count_of(written.rollouts, 'episode')}, {written.videos} with a video")
        say(f"open {written.page}")


def _write_next_to_log(run: Run) -> None:
    """Write report.json and report.md of an evaluation where its folder can be written."""
    from lerobot_memobench.envs.episode_log import is_archive
    from lerobot_memobench.evaluation.report import write_report

    if is_archive(run.folder):
        return
    try:
        with locked(run.folder, run.folder):
            write_report(run.folder)
    except (OSError, HeldError) as error:  # a read-only archive, or an evaluation that runs
        note(f"memobench: {run.folder} is not written to ({getattr(error, 'strerror', None) or error})")


def compare(
    a: Annotated[str, typer.Argument(help="Folder of an evaluation, or NAME=FOLDER.", metavar="A")],
    b: Annotated[str, typer.Argument(help="The evaluation to compare with it.", metavar="B")],
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
    """Compare two evaluations of the same episodes, pair by pair. McNemar for success, sign-flip for the rates.

    Evaluations that differ in the setting of a control (pauses, corrupted memory, interference, …) are reported as it.
    """
    from lerobot_memobench.evaluation.comparison import compare_evaluations, comparison_csv, comparison_report
    from lerobot_memobench.evaluation.records import read_runs

    first, second = read_runs([a, b])
    found = compare_evaluations(first, second, allow=allow or (), seed=seed, permutations=permutations)
    show_report(comparison_report(found), "compare", format_, out, comparison_csv(found))


def merge(
    out: Annotated[Path, typer.Argument(help="Folder of the whole evaluation.")],
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of its parts; OUT/shard-*-of-* when left out.")
    ] = None,
) -> int:
    """Join the parts of an evaluation and report the whole. They ran with shard=i/n. Status 1: some are missing."""
    from lerobot_memobench.cli.lerobot import print_report
    from lerobot_memobench.run.shards import merge_and_report, part_folders

    return print_report(merge_and_report(out, folders or part_folders(out)))


def rerun(
    card: Annotated[Path, typer.Argument(help="The folder of an evaluation, or its evaluation.json.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the repetition; a dated one when left out.")] = None,
    server: Annotated[
        str | None,
        typer.Option(help="Address of the card's policy server, host:port; optional on 127.0.0.1."),
    ] = None,
) -> int:
    """Repeat the evaluation of a card and compare every episode. Status 1: one ended differently."""
    from lerobot_memobench.cli.lerobot import evaluate_here
    from lerobot_memobench.run.rerun import repeat

    return repeat(card, out, server, evaluate_here, say)


def show_report(
    report: Report, name: str, formats: Sequence[ReportFormat] | None, out: Path | None, as_csv: str | None = None
) -> None:
    """Print a report in the formats wanted, or write it to a folder as ``name`` with the formats' endings.

    Args:
        as_csv: its figures as CSV, one a row, in the place of its tables.

    Raises:
        MemobenchError: ``out`` is a file.
    """
    from lerobot_memobench.evaluation.tables import WRITERS, csv_tables, terminal

    if out is not None:
        if out.exists() and not out.is_dir():
            raise MemobenchError(f"--out {out} is a file; name a folder")
        out.mkdir(parents=True, exist_ok=True)
    for each in dict.fromkeys(formats or [ReportFormat.TABLE]):
        if out is None and each is ReportFormat.TABLE:
            console().print(terminal(report), crop=False)
            continue
        if each is not ReportFormat.CSV:
            texts = {f"{name}.{ENDINGS[each]}": WRITERS[each](report)}
        elif as_csv is None:
            texts = {f"tables/{key}.csv": text for key, text in csv_tables(report).items()}
        else:
            texts = {f"{name}.csv": as_csv}
        if out is None:
            print("\n".join(texts.values()), end="")
            continue
        for file, text in texts.items():
            (out / file).parent.mkdir(exist_ok=True)
            say(write_file(out / file, text))
