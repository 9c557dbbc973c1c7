"""``lerobot eval``: parse the arguments, make the plan, run it, print what it found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_memobench.cli.console import WITH_PARENT, console, counting, say, tell
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.report import table
from lerobot_memobench.evaluation.report_tables import failure_line
from lerobot_memobench.io import count_of
from lerobot_memobench.jobs.processes import saying_how_to_go_on
from lerobot_memobench.run.arguments import Arguments
from lerobot_memobench.run.lerobot_commands import call_lerobot
from lerobot_memobench.run.merging import merge_and_report
from lerobot_memobench.run.plan import EvaluationPlan, make_plan, read_other, take_run_options
from lerobot_memobench.run.run import EvaluationReport, run_evaluation
from lerobot_memobench.run.settings import read_settings
from lerobot_memobench.run.shards import plan_shards, run_shards, slurm_of

if TYPE_CHECKING:
    from lerobot_memobench.jobs.processes import Advance


SHARD_PROGRAM = ("-m", "lerobot_memobench.cli.lerobot", WITH_PARENT)
"""Arguments of Python that start the process of one part."""


def evaluate(given: Arguments, command: Sequence[str]) -> int:
    """Run ``lerobot eval`` on the benchmark.

    Args:
        command: the whole command line, for the card.
    """
    options, given = take_run_options(given)
    plan = make_plan(read_settings(given), options, command)
    with saying_how_to_go_on("lerobot", lambda: f"go on with: {plan.going_on}"):
        return evaluate_in_parts(plan) if options.shards else evaluate_here(plan)


def evaluate_elsewhere(given: Arguments) -> int:
    """Run ``lerobot-eval`` on another environment of LeRobot's, after checking the arguments."""
    return call_lerobot("eval", read_other(given).for_parser)


def evaluate_here(plan: EvaluationPlan, say_where: bool = True) -> int:
    """Run an evaluation, or the part of it that is asked for, and print its report.

    Args:
        say_where: whether the report's file is named.
    """
    with counting(console(), "episodes") as count:
        report = run_evaluation(plan, tell, say, count)
    if report is None:
        print(f"part {plan.options.shard} holds no episode: there are fewer batches than parts")
        return 0
    print_figures(report)
    if say_where:
        print(f"report: {report.page}")
    return 0


def evaluate_in_parts(plan: EvaluationPlan) -> int:
    """Run all parts of an evaluation as jobs, merge them and print the report; 1 when episodes are missing."""
    jobs = plan_shards(plan, SHARD_PROGRAM, tell)
    with counting(console(), "parts", len(jobs)) as count:

        def advance(news: Advance) -> None:
            count(news.done, news.total, news.task_name, found=news.found)

        report = run_shards(plan, jobs, advance, finish=merge_and_print)
    if report is not None:
        return print_merged(report)
    say(f"jobs are submitted; the last of them merges the parts in {plan.output.absolute()}")
    if (slurm := slurm_of(plan)) is not None:
        say(slurm.summary)
    return 0


def merge_and_print(out: Path, folders: Sequence[Path]) -> int:
    """Merge parts into ``out`` and print the report; return 1 when episodes that were asked for are missing."""
    return print_merged(merge_and_report(out, folders))


def print_merged(report: EvaluationReport) -> int:
    """Print the report of a merged evaluation; return 1 when episodes that were asked for are missing."""
    print_figures(report)
    say(f"report: {report.page}")
    if not report.absent:
        return 0
    task, episode = report.absent[0]
    was, is_ = ("was", "is") if len(report.absent) == 1 else ("were", "are")
    say(
        f"note: {count_of(len(report.absent), 'episode')} that {was} asked for {is_} missing, the first is {task}, "
        f"episode {episode}; run their parts with resume=true and merge again"
    )
    return 1


def print_figures(report: EvaluationReport) -> None:
    """Print a report's first line, its table, its failures and what a reader must know."""
    screen, run = console(), report.run
    screen.print()
    screen.print(headline([run]), style="bold")
    screen.print(table(run.summary), crop=False)
    screen.print(failure_line(run.summary))
    for note in run.notes:
        screen.print(f"note: {note}")
