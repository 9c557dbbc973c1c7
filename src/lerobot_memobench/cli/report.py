"""``memobench report``, ``compare``, ``html``, ``merge``, ``rerun`` and ``controls``: what evaluations found."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console, say, tell
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import count_of, write_file
from lerobot_memobench.jobs.processes import HeldError, locked

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.records import Run
    from lerobot_memobench.evaluation.tables import Report


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
    typer.Option("--format", help="table (default), markdown, csv, latex or json; repeatable."),
]

ENDINGS = {
    ReportFormat.TABLE: "txt",
    ReportFormat.MARKDOWN: "md",
    ReportFormat.CSV: "csv",
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
    format_: Formats = None,
    with_: With = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder that the report is written to, instead of being printed.")
    ] = None,
) -> None:
    """Report SR, MSR, MUR and MCR of evaluations. Also prefix completion, failures and replan sweeps.

    report.json and report.md of each evaluation are written beside its log as well, but for a compressed one.
    """
    from lerobot_memobench.envs.episode_log import is_archive
    from lerobot_memobench.evaluation.records import read_runs
    from lerobot_memobench.evaluation.report import build, render, write_documents, write_report
    from lerobot_memobench.evaluation.tables import terminal

    runs = read_runs(folders)
    wanted = list(dict.fromkeys(each.value for each in format_ or [ReportFormat.TABLE]))
    paper = with_ is Beside.PAPER
    for run in runs:
        if is_archive(run.folder):
            continue
        try:
            with locked(run.folder, run.folder):
                write_report(run.folder)
        except (OSError, HeldError) as error:  # an archive that is only read, or an evaluation that runs
            tell(f"memobench: {run.folder} is not written to ({getattr(error, 'strerror', None) or error})")
    if out is not None:
        for path in write_documents(runs, out, wanted, paper):
            say(path)
        return
    found = build(runs, paper)
    for name in wanted:
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
    from lerobot_memobench.evaluation.comparison import compare as compared
    from lerobot_memobench.evaluation.comparison import comparison_csv, comparison_report
    from lerobot_memobench.evaluation.records import read_runs

    first, second = read_runs([a, b])
    found = compared(first, second, allow=allow or (), seed=seed, permutations=permutations)
    show_report(comparison_report(found), "compare", format_, out, comparison_csv(found))


def html(
    folders: Runs,
    out: Annotated[Path, typer.Option(help="Folder of the report; an earlier report there is replaced.")] = Path(
        "outputs/html"
    ),
    link: Annotated[
        bool,
        typer.Option("--link", help="Link to the videos where they are: saves space, but the folder cannot be moved."),
    ] = False,
    task_dir: Annotated[
        Path | None,
        typer.Option(help="Tasks in the published format that the evaluations ran, beside the catalogue's."),
    ] = None,
) -> None:
    """Make a report for the browser. Rates, failures, each episode's video over its timeline, two side by side."""
    from lerobot_memobench.evaluation.html.write import write_html

    written = write_html(folders, out, link=link, task_dir=task_dir)
    for note in written.notes:
        say(f"note: {note}")
    say(f"{count_of(written.rollouts, 'episode')}, {written.videos} with a video")
    say(f"open {written.page}")


def merge(
    out: Annotated[Path, typer.Argument(help="Folder of the whole evaluation.")],
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of its parts; OUT/shard-*-of-* when left out.")
    ] = None,
) -> int:
    """Join the parts of an evaluation and report the whole. They ran with shard=i/n. Status 1: some are missing."""
    from lerobot_memobench.cli.evaluate import merge_and_print
    from lerobot_memobench.run.merging import part_folders

    return merge_and_print(out, folders or part_folders(out))


def rerun(
    card: Annotated[Path, typer.Argument(help="The folder of an evaluation, or its evaluation.json.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the repetition; a dated one when left out.")] = None,
    server: Annotated[
        str | None, typer.Option(help="Where the card's policy server is here, host:port; 127.0.0.1 needs no saying.")
    ] = None,
) -> int:
    """Repeat the evaluation of a card and compare every episode. Status 1: one ended differently."""
    from lerobot_memobench.cli.evaluate import evaluate_here
    from lerobot_memobench.run.rerun import repeat

    return repeat(card, out, server, evaluate_here, say)


controls = typer.Typer(
    help="Report controls. The paper's: oracle memory, shuffled memory, granularity; and pauses, speed, evidence.",
    no_args_is_help=True,
)

TableOut = Annotated[Path | None, typer.Option(help="Folder to write the table to, as Markdown, LaTeX and JSON.")]
Draws = Annotated[int, typer.Option(min=100, help="Bootstrap draws of the intervals.")]


@controls.command()
def oracle(
    standard: Annotated[
        list[Path], typer.Argument(help="Evaluations of the policy as it is; one per replan interval.")
    ],
    oracle: Annotated[
        list[Path], typer.Option("--oracle", help="Evaluation of the policy with oracle memory text; repeatable.")
    ],
    beside: With = None,
    draws: Draws = 2000,
    out: TableOut = None,
) -> int:
    """Print which share of the gap to 100 % oracle memory closes: what a perfect memory would recover."""
    from lerobot_memobench.evaluation.controls import check_place, pairs_by_replan
    from lerobot_memobench.evaluation.memory_controls import contrasts, oracle_report, published_contrasts
    from lerobot_memobench.paper import raw_tables

    check_place(standard, "oracle_memory", False)
    check_place(oracle, "oracle_memory", True)
    pairs, notes = pairs_by_replan(standard, oracle, ignore=("oracle_memory",))
    found = {replan: contrasts(a, b, draws) for replan, (a, b) in pairs.items()}
    published = raw_tables()["oracle_memory"]
    paper = (published["replan_steps"], published_contrasts(published)) if beside else None
    return _show(oracle_report(found, paper), notes, "oracle", out)


@controls.command()
def shuffled(
    normal: Annotated[Path, typer.Argument(help="Evaluation of the policy taught with subgoals in order.")],
    shuffled: Annotated[Path, typer.Argument(help="Evaluation of the policy taught with shuffled subgoals.")],
    beside: With = None,
    draws: Draws = 2000,
    out: TableOut = None,
) -> int:
    """Print how far rollouts come with normal and with shuffled memory, checkpoint by checkpoint."""
    from lerobot_memobench.evaluation.controls import check_place, pairs_by_replan
    from lerobot_memobench.evaluation.memory_controls import prefix_curves, shuffled_report
    from lerobot_memobench.paper import shuffled_control

    check_place([normal], "shuffle_subgoals", False, of_policy=True)
    check_place([shuffled], "shuffle_subgoals", True, of_policy=True)
    pairs, notes = pairs_by_replan([normal], [shuffled])
    found = {replan: prefix_curves(a, b, draws) for replan, (a, b) in pairs.items()}
    return _show(shuffled_report(found, shuffled_control() if beside else None), notes, "shuffled", out)


@controls.command()
def granularity(
    coarse: Annotated[Path, typer.Option(help="Evaluation of the policy taught with coarse subgoals.")],
    intermediate: Annotated[Path, typer.Option(help="The same with intermediate subgoals.")],
    fine: Annotated[Path, typer.Option(help="The same with fine subgoals.")],
    beside: With = None,
    out: TableOut = None,
) -> int:
    """Print the metrics by the language level of the subgoals that a policy was taught with."""
    from lerobot_memobench.evaluation.controls import granularity_report, rollouts_by_level

    levels, notes = rollouts_by_level(coarse, intermediate, fine)
    return _show(granularity_report(levels, paper=bool(beside)), notes, "granularity", out)


Plain = Annotated[Path, typer.Argument(help="Evaluation of the policy as it is.")]


@controls.command()
def pauses(
    plain: Plain,
    paused: Annotated[Path, typer.Argument(help="Evaluation of the same policy and episodes with pause_steps=.")],
    draws: Draws = 2000,
    out: TableOut = None,
) -> int:
    """Print what a policy loses when the robot rests now and then. It joins the report of the paused evaluation."""
    return _pacing("pauses", "pause_steps", plain, paused, draws, out)


@controls.command()
def speed(
    plain: Plain,
    slow: Annotated[Path, typer.Argument(help="Evaluation of the same policy and episodes with speed= below 1.")],
    draws: Draws = 2000,
    out: TableOut = None,
) -> int:
    """Print what a policy loses when every action takes longer. It joins the report of the slower evaluation."""
    return _pacing("speed", "speed", plain, slow, draws, out)


@controls.command()
def evidence(folders: Runs, draws: Draws = 2000, out: TableOut = None) -> int:
    """Print how often the choice follows the evidence, beside chance. Evaluations with evidence=true, side by side."""
    from lerobot_memobench.evaluation.evidence_controls import (
        evidence_data,
        evidence_of,
        evidence_section,
        ran_evidence,
    )
    from lerobot_memobench.evaluation.records import read_runs, unlike
    from lerobot_memobench.evaluation.tables import Report

    runs = read_runs(folders)
    for run in runs:
        if not ran_evidence(run.records):
            raise MemobenchError(
                f"{run.folder} did not run each scene with each variant; evaluate with evidence=true, of published "
                "tasks with referent=random"
            )
    found = [evidence_of(run.records, draws) for run in runs]
    sections = [replace(evidence_section(each), title=run.name) for run, each in zip(runs, found, strict=True)]
    figures = {run.name: evidence_data(each, run.records) for run, each in zip(runs, found, strict=True)}
    report = Report("Evidence", tuple(sections), figures)
    return _show(report, unlike(runs), "evidence", out)


def _pacing(name: str, setting: str, plain: Path, paced: Path, draws: int, out: Path | None) -> int:
    from lerobot_memobench.envs.episode_log import is_archive
    from lerobot_memobench.evaluation.pacing_controls import keep_changes, paced_changes, pacing_section
    from lerobot_memobench.evaluation.report import write_report
    from lerobot_memobench.evaluation.tables import Report

    found, notes = paced_changes(setting, plain, paced, draws)
    if not is_archive(paced):
        with locked(paced, paced):
            keep_changes(paced, found)
            write_report(paced)
    section = pacing_section(found)
    report = Report(section.title, (replace(section, title=""),), {"changes": found})
    return _show(report, notes, name, out)


def _show(report: Report, notes: Sequence[str], name: str, out: Path | None) -> int:
    """Print a report, and write it where asked; return the exit status."""
    from lerobot_memobench.evaluation.tables import latex, markdown, terminal

    noted = replace(report, sections=tuple(replace(each, notes=(*each.notes, *notes)) for each in report.sections))
    told = " ".join(f"{note}." for note in notes)
    captioned = [
        replace(each, tables=tuple(replace(t, note=f"{t.note} {told}") for t in each.tables))
        for each in report.sections
    ]
    console().print(terminal(noted), crop=False)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        data = {"title": report.title, "notes": list(notes), **report.data}
        contents = {
            "md": markdown(noted),
            "tex": latex(replace(report, sections=tuple(captioned))),
            "json": json.dumps(data, indent=1) + "\n",
        }
        for ending, content in contents.items():
            say(write_file(out / f"{name}.{ending}", content))
    return 0


def given_runs(folders: list[str] | None, with_: Beside | None) -> tuple[list[Run], bool]:
    """Return the evaluations and whether the paper's figures are drawn; one of both is needed."""
    from lerobot_memobench.evaluation.records import read_runs, unlike
    from lerobot_memobench.evaluation.report_tables import check_beside

    paper = with_ is Beside.PAPER
    if not folders and not paper:
        raise MemobenchError("there is nothing to draw; name folders of evaluations, or --with paper, or both")
    runs = read_runs(folders) if folders else []
    check_beside(runs, paper)
    for note in unlike(runs):
        tell(f"memobench: note: {note}")
    return runs, paper


def show_report(
    report: Report, name: str, formats: Sequence[ReportFormat] | None, out: Path | None, as_csv: str | None = None
) -> None:
    """Print a report in the formats wanted, or write it to a folder as ``name`` with the formats' endings.

    Args:
        as_csv: its figures as CSV, one a row; its tables under one another when None.
    """
    from lerobot_memobench.evaluation.tables import WRITERS, csv_tables, terminal

    for each in dict.fromkeys(formats or [ReportFormat.TABLE]):
        if out is None and each is ReportFormat.TABLE:
            console().print(terminal(report), crop=False)
            continue
        if each is ReportFormat.CSV:
            text = "\n".join(csv_tables(report).values()) if as_csv is None else as_csv
        else:
            text = WRITERS[each](report)
        if out is None:
            print(text, end="")
        else:
            out.mkdir(parents=True, exist_ok=True)
            say(write_file(out / f"{name}.{ENDINGS[each]}", text))
