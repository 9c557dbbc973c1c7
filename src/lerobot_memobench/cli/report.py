"""``memobench report``, ``compare``, ``merge``, ``rerun``, ``submit`` and ``export``: results of evaluations."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console, note, say
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.io import write_file
from lerobot_memobench.jobs.processes import HeldError, locked
from lerobot_memobench.untrusted import checked

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.records import Run
    from lerobot_memobench.evaluation.tables import Report


# an enumeration, because typer takes no list of literals
ReportFormat = StrEnum("ReportFormat", ["TABLE", "MARKDOWN", "CSV", "LATEX", "JSON"])
ENDINGS = {"table": "txt", "markdown": "md", "latex": "tex", "json": "json"}

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
        for evaluation in run.evaluations:
            _write_next_to_log(evaluation)
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
    from lerobot_memobench.evaluation.comparison import compare_evaluations, comparison_report
    from lerobot_memobench.evaluation.records import read_runs
    from lerobot_memobench.evaluation.tables import csv_text

    first, second = read_runs([a, b])
    comparison = compare_evaluations(first, second, allow=allow or (), seed=seed, permutations=permutations)
    compared = comparison_report(comparison)
    show_report(compared, "compare", format_, out, csv_text(compared.data["differences"]))


def merge(
    out: Annotated[Path, typer.Argument(help="Folder of the whole evaluation.")],
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of its parts; OUT/shard-*-of-* when left out.")
    ] = None,
) -> int:
    """Join the parts of an evaluation and report the whole. They ran with shard=i/n. Status 1: some are missing."""
    from lerobot_memobench.cli.lerobot import print_report
    from lerobot_memobench.rollouts.shards import merge_and_report, part_folders

    return print_report(merge_and_report(out, folders or part_folders(out)))


def rerun(
    card: Annotated[Path, typer.Argument(help="The folder of an evaluation, or its evaluation.json.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the repetition; a dated one when left out.")] = None,
    server: Annotated[
        str | None, typer.Option(help="Address of the card's policy server, host:port; optional on 127.0.0.1.")
    ] = None,
) -> int:
    """Repeat the evaluation of a card and compare every episode. Status 1: one ended differently."""
    from lerobot_memobench.cli.lerobot import evaluate_here
    from lerobot_memobench.rollouts.rerun import repeat

    return repeat(card, out, server, evaluate_here, say)


def submit(
    card: Annotated[Path, typer.Argument(help="The folder of a finished evaluation.")],
    name: Annotated[str, typer.Option(help="Name of the row's folder: lower-case letters, digits, _ and -.")] = "",
    model: Annotated[str, typer.Option(help="Name of the policy, as the board shows it.")] = "",
    submitter: Annotated[str, typer.Option(help="You or your team; @name for a GitHub account.")] = "",
    training_data: Annotated[str, typer.Option(help="Origin and number of the demonstrations, in a few words.")] = "",
    check: Annotated[
        bool, typer.Option(help="Check only: any tasks and episodes, no name or model; write nothing.")
    ] = False,
    parameters: Annotated[int | None, typer.Option(min=0, help="Number of parameters; 0 for a script.")] = None,
    code: Annotated[str | None, typer.Option(help="Address of the code, https://…")] = None,
    weights: Annotated[str | None, typer.Option(help="Address of the weights, https://…")] = None,
    paper: Annotated[str | None, typer.Option(help="Address of the paper, https://…")] = None,
    pauses: Annotated[
        Path | None, typer.Option(help="Folder of an evaluation of the same policy with pause_steps=100.")
    ] = None,
    without_memory: Annotated[
        str | None, typer.Option(help="Row of the board with a partner that has no memory.", metavar="NAME")
    ] = None,
    supervised_with_answer: Annotated[
        bool | None,
        typer.Option(help="Whether texts that name the hidden answer were learned from; memobench_mem records it."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the submission and the text of the pull request.")] = Path(
        "outputs/board"
    ),
) -> None:
    """Check a result by the rules of the board, and write its submission.

    It consists of a folder for results/board and the text of a pull request.
    """
    from lerobot_memobench.board import rules
    from lerobot_memobench.board.submission import (
        BOARD,
        LINKS,
        PAUSES,
        About,
        RowName,
        own_evaluation,
        pull_request,
        write_submission,
    )

    required = {"--name": name, "--model": model, "--submitter": submitter, "--training-data": training_data}
    if missing := [option for option, text in required.items() if not (text or check)]:
        raise MemobenchError(f"a submission needs {', '.join(missing)}; to check a result alone, give --check")
    if check:
        name, model, submitter, training_data = (text or "unnamed" for text in (name, model, submitter, training_data))
    checked(name, RowName)
    links = dict(zip(LINKS, (code, weights, paper), strict=True))
    about = checked(
        {
            **{"model": model, "submitter": submitter, "date": f"{dt.date.today()}", "training_data": training_data},
            **{"parameters": parameters, "without_memory": without_memory},
            "supervised_with_answer": supervised_with_answer,
            "links": {key: link for key, link in links.items() if link is not None},
        },
        About,
    )
    evaluation = own_evaluation(card)
    rules.check_evaluation(evaluation, part=check)
    if pauses:
        rules.check_control(evaluation, own_evaluation(pauses), PAUSES, part=check)
    rules.supervised_with_answer(evaluation, about)
    if check:
        return say(f"accepted: {count_of(len(evaluation.records), 'rollout')} of {card}; nothing is written")
    write_submission(out / name, about, {"": card, **({PAUSES: pauses} if pauses else {})})
    say(f"accepted: {out / name}")
    say(f"text of the pull request: {write_file(out / f'{name}.md', pull_request(name, about, evaluation))}")
    say(f"next: copy {out / name} to {BOARD / name} in a copy of the repository, check it there by")
    say(f"`python -m tools.board {BOARD}`, and open the pull request")


def export(
    card: Annotated[Path, typer.Argument(help="The folder of an evaluation, or of a row of the board.")],
    dataset: Annotated[str, typer.Option(help="Repository of the benchmark's dataset on the hub, user/name.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the model's repository; the text is printed when left out.")
    ] = None,
) -> None:
    """Export a result for the page of a model on the Hugging Face hub, .eval_results/memobench.yaml."""
    from lerobot_memobench.evaluation.records import read_runs
    from lerobot_memobench.evaluation.report import HUB_FILE, huggingface_yaml

    (run,) = read_runs([card])
    text = huggingface_yaml(run, dataset)
    if out is None:
        print(text, end="")
        return
    (out / HUB_FILE).parent.mkdir(parents=True, exist_ok=True)
    say(write_file(out / HUB_FILE, text))


def show_report(
    report: Report, name: str, formats: Sequence[str] | None, out: Path | None, as_csv: str | None = None
) -> None:
    """Print a report in the formats wanted, or write it to a folder; ``as_csv`` replaces its tables in CSV."""
    from lerobot_memobench.evaluation.tables import WRITERS, csv_tables, terminal

    if out is not None:
        if out.exists() and not out.is_dir():
            raise MemobenchError(f"--out {out} is a file; name a folder")
        out.mkdir(parents=True, exist_ok=True)
    for format_ in dict.fromkeys(formats or ["table"]):
        if out is None and format_ == "table":
            console().print(terminal(report), crop=False)
            continue
        if format_ != "csv":
            texts = {f"{name}.{ENDINGS[format_]}": WRITERS[format_](report)}
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
