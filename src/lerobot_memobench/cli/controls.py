"""``memobench necessity`` and ``memobench controls …``: what tasks ask of a memory, and what controls tell of it."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console, counting
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks, task_names
from lerobot_memobench.tasks.task import LEVELS

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.documents.tables import Report
    from lerobot_memobench.evaluation.metrics.rollouts import Record
    from lerobot_memobench.evaluation.necessity.study import Result


app = typer.Typer(
    help="What the paper's controls tell: oracle memory, shuffled memory, annotation granularity.", no_args_is_help=True
)


class WhichReferent(StrEnum):
    """Which settings of the referent are looked at."""

    FIXED = "fixed"
    RANDOM = "random"
    BOTH = "both"


def necessity(
    tasks: Annotated[str, typer.Option(help="all, memory types or task names, separated by commas.")] = "all",
    referent: Annotated[
        WhichReferent, typer.Option(help="Goal of object and procedural tasks: fixed, random, or both settings.")
    ] = WhichReferent.BOTH,
    episodes: Annotated[int, typer.Option(min=1, help="Scenes per task, from seed 7 on.")] = 3,
    budget: Annotated[
        int, typer.Option(min=0, help="Steps simulated per task in search of other ways to the goal; 0: no search.")
    ] = 10_000,
    tolerance: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of differing pixels up to which pictures look the same.")
    ] = 0.005,
    out: Annotated[Path, typer.Option(help="Folder of the results; the same command goes on there.")] = Path(
        "outputs/necessity"
    ),
    page: Annotated[
        Path | None, typer.Option(help="Markdown page whose table is made anew, between its marks.")
    ] = None,
) -> int:
    """Find moments that look the same and need different answers; print what a policy without memory can reach."""
    from lerobot_memobench.evaluation.necessity.question import REFERENTS, Settings
    from lerobot_memobench.evaluation.necessity.report import put_into_page, terminal_table, write
    from lerobot_memobench.evaluation.necessity.study import study

    settings = Settings(episodes=episodes, budget=budget, tolerance=tolerance)
    settings_of = REFERENTS if referent is WhichReferent.BOTH else (referent.value,)
    chosen = [get_task(name) for name in resolve_tasks(tasks)]
    jobs = [
        (task, setting)
        for task in chosen
        for setting in settings_of
        # With one goal only, both settings are the same.
        if task.num_variants > 1 or setting == settings_of[0]
    ]
    screen = console()
    results: list[Result] = []
    with counting(screen, "tasks", len(jobs)) as count:
        for task, setting in jobs:
            results.append(study(task, setting if task.num_variants > 1 else REFERENTS[0], settings, out))
            count(len(results), len(jobs), f"{task.name}, referent {setting}")
    written = write(out, results)
    if page is not None:
        written.append(put_into_page(page, results))
    screen.print(terminal_table(results))
    for path in written:
        screen.print(str(path), soft_wrap=True)
    return 0


# --- controls ---


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
    from lerobot_memobench.evaluation.comparison.oracle_memory import contrasts, oracle_report, published_contrasts
    from lerobot_memobench.paper import raw_tables

    pairs, notes = _pairs(standard, oracle, ignore=("oracle_memory",))
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
    from lerobot_memobench.evaluation.comparison.shuffled_memory import prefix_curves, shuffled_report
    from lerobot_memobench.paper import shuffled_control

    pairs, notes = _pairs([normal], [shuffled])
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
    from lerobot_memobench.envs.episode_log import read_episodes
    from lerobot_memobench.evaluation.comparison.granularity import granularity_report, relabelled
    from lerobot_memobench.evaluation.comparison.pairing import by_replan

    folders = dict(zip(LEVELS, (coarse, intermediate, fine), strict=True))
    for folder in (intermediate, fine):
        _refuse_unlike([coarse], [folder])
    notes: list[str] = []
    levels = {level: read_episodes(folder, notes) for level, folder in folders.items()}
    intervals = {level: list(by_replan(records)) for level, records in levels.items()}
    if len({tuple(found) for found in intervals.values()}) > 1:
        told = ", ".join(f"{level} {'/'.join(map(str, found))}" for level, found in intervals.items())
        raise MemobenchError(f"the levels were evaluated at different replan intervals ({told}); use the same replan=")
    if len(intervals[LEVELS[0]]) > 1:
        notes.append("the evaluations mix replan intervals; the figures are over all of them")
    own = {}
    for index, (level, records) in enumerate(levels.items()):
        labels = {
            name: [checkpoint.operations_by_level[index] for checkpoint in get_task(name).checkpoints]
            for name in {record["task"] for record in records} & set(task_names())
        }
        own[level] = relabelled(records, labels)
    return _show(granularity_report(levels, own, paper=bool(beside)), notes, "granularity", out)


def _pairs(
    first: Sequence[Path], second: Sequence[Path], ignore: Sequence[str] = ()
) -> tuple[dict[int | None, tuple[list[Record], list[Record]]], list[str]]:
    """Return the paired rollouts of two sets of evaluations by replan interval, and what a reader must know."""
    from lerobot_memobench.envs.episode_log import read_episodes
    from lerobot_memobench.evaluation.comparison.pairing import by_replan, paired

    _refuse_unlike(first, second, ignore)
    notes: list[str] = []
    a, b = (
        by_replan([record for folder in folders for record in read_episodes(folder, notes)])
        for folders in (first, second)
    )
    common = [replan for replan in a if replan in b]
    if not common:
        raise MemobenchError(
            f"the evaluations have no replan interval in common ({', '.join(map(str, a))} and "
            f"{', '.join(map(str, b))}); evaluate both with the same replan="
        )
    for replan in [*a, *b]:
        if replan not in common:
            notes.append(f"replan interval {replan} is in one of them only and is left out")
    found: dict[int | None, tuple[list[Record], list[Record]]] = {}
    for replan in common:
        left, right, alone = paired(a[replan], b[replan])
        found[replan] = (left, right)
        if alone:
            notes.append(f"replan interval {replan}: {alone} rollouts have no partner and are left out")
    return found, notes


def _refuse_unlike(first: Sequence[Path], second: Sequence[Path], ignore: Sequence[str] = ()) -> None:
    """Raise when evaluations differ in more than the policy, the replan interval and what is ignored."""
    from lerobot_memobench.evaluation.records.protocol import differences, read_protocol

    reference = read_protocol(first[0])
    for folder in [*first[1:], *second]:
        found = differences(reference, read_protocol(folder), ignore=("replan_steps", *ignore))
        if found:
            raise MemobenchError(
                f"{first[0]} and {folder} were evaluated under different protocols ({'; '.join(found)}); evaluate both "
                "under the same one"
            )


def _show(report: Report, notes: Sequence[str], name: str, out: Path | None) -> int:
    """Print a report, and write it where asked; return the exit status."""
    from lerobot_memobench.evaluation.documents.formats import latex, markdown, terminal

    screen = console()
    screen.print(terminal(report))
    for note in notes:
        screen.print(f"note: {note}", markup=False)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        data = {"title": report.title, "notes": list(notes), **report.data}
        contents = {"md": markdown(report), "tex": latex(report), "json": json.dumps(data, indent=1) + "\n"}
        for ending, content in contents.items():
            path = out / f"{name}.{ending}"
            draft = path.with_name(path.name + ".part")
            draft.write_text(content)
            os.replace(draft, path)
            screen.print(str(path), soft_wrap=True)
    return 0
