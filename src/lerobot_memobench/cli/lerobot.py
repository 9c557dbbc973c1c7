"""The command ``lerobot``: ``lerobot <name> key=value …`` runs LeRobot's ``lerobot-<name>``.

``lerobot eval env=memobench`` and ``lerobot train`` check their settings, set the benchmark's defaults and run loops of
their own (``rollouts.plan``, ``training.command``). For any other command ``key=value`` becomes ``--key=value``.
"""

from __future__ import annotations

import os
import shlex
import sys
import textwrap
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, fields
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from lerobot_memobench.cli.console import as_path, console, counting, note, run_command, say
from lerobot_memobench.commands.command_line import (
    CONFIG_FILE,
    HELP,
    PACKAGES,
    PATH,
    RUN_OPTIONS,
    SHORT_FORMS,
    TYPE,
    as_command_line,
    call_lerobot,
    check_names,
    is_of_benchmark,
    lerobot_commands,
    parse_words,
    read_words,
    without,
)
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.io import explaining_disk_errors
from lerobot_memobench.jobs.processes import adding_resume_hint
from lerobot_memobench.jobs.threads import ACTING, use_threads
from lerobot_memobench.tasks.catalogue import lerobots_choice, resolve_tasks
from lerobot_memobench.tasks.task import PUBLISHED

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.records import Run
    from lerobot_memobench.jobs.processes import Advance
    from lerobot_memobench.rollouts.plan import EvaluationPlan

WITH_PARENT = "--with-parent"
"""First argument of a process that ends when its standard input closes, with the process that started it."""
SHARD_PROGRAM = ("-m", "lerobot_memobench.cli.lerobot", WITH_PARENT)
"""Arguments of Python that start the process of one part."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    line = [as_path(word) for word in (sys.argv[1:] if argv is None else argv)]
    return run_command(partial(run, line), "lerobot", f"start again with: {shlex.join(['lerobot', *line])}")


def run(line: Sequence[str]) -> int:
    """Run the command line."""
    commands = lerobot_commands()
    if not line or line[0] in ("-h", "--help", "help"):
        print(help_text("").replace("{commands}", ", ".join(sorted(commands))), end="")
        return 0
    name = line[0]
    if name not in commands:
        raise MemobenchError(f"there is no command {name!r}, {nearest(name, commands)}")
    if name not in SHORT_FORMS:  # its words are passed on
        return call_lerobot(
            name, [word if word.startswith("-") or "=" not in word else f"--{word}" for word in line[1:]]
        )
    words = parse_words(line[1:])
    if HELP in words:
        print(help_of(name), flush=True)
        if len(words) == 1:
            print(f"all settings: `lerobot {name} --help` with env= or policy=, which imports LeRobot")
            return 0
    if sys.flags.optimize > 1:
        raise MemobenchError("found python -OO or PYTHONOPTIMIZE=2, and transformers reads docstrings; use -O or 1")
    check_names(name, words)
    if name == "train":
        from lerobot_memobench.training.command import run_training

        return run_training(words, note)
    use_threads(ACTING)  # before torch is imported
    if is_of_benchmark(words) and HELP not in words:
        return evaluate(words)
    return call_lerobot(name, flags_of_other(words))


def help_of(command: str) -> str:
    """Return the help of ``lerobot eval`` or ``lerobot train``, with the settings of the environment."""
    return help_text(f"_{command}").replace("{environment}", "".join(map(explained, fields(EnvSettings))))


def help_text(command: str) -> str:
    """Return the text of a help file."""
    return Path(__file__).with_name(f"lerobot{command}.txt").read_text(encoding="utf-8")


def explained(setting: Field[Any]) -> str:
    """Return the entry of a setting in the help: name, meaning, values and default."""
    meaning, values, usual = (setting.metadata[key] for key in ("meaning", "values", "usual"))
    default = "none" if setting.default is None else str(setting.default)
    plain = default.lower() if isinstance(setting.default, bool) else default
    accepted = f"; {', '.join(values)}" if values else ""
    text = textwrap.fill(f"{meaning}{accepted} (default: {usual or plain})", 92)  # 100 with the indent
    return f"  {setting.name}=\n{textwrap.indent(text, ' ' * 8)}\n"


# --- eval ---


def evaluate(words: Mapping[str, str]) -> int:
    """Run ``lerobot eval`` on the benchmark."""
    suites = check_tasks(words)
    if len(suites) > 1:
        return evaluate_suites(suites, words)
    from lerobot_memobench.rollouts.plan import plan_line

    plan = plan_line(as_command_line(words))
    hint = f"resume with: {plan.resuming_command}"
    with (
        adding_resume_hint("lerobot", lambda: hint),
        explaining_disk_errors(plan.output, f"finished episodes stay; {hint}"),
    ):
        return evaluate_in_parts(plan) if plan.options.shards else evaluate_here(plan)


def evaluate_suites(suites: Sequence[str], words: Mapping[str, str]) -> int:
    """Run an evaluation of each of several suites of LIBERO, in a folder of its name; return the highest status."""
    from lerobot_memobench.envs.episode_log import has_log
    from lerobot_memobench.evaluation.records import read_runs
    from lerobot_memobench.evaluation.report import memory_types_table
    from lerobot_memobench.evaluation.tables import terminal_table

    output = words.get("output_dir")
    if output is None and "resume" not in words:
        output = f"outputs/eval/{datetime.now():%Y-%m-%d/%H-%M-%S}_memobench"
    status, folders = 0, list[Path]()
    for suite in suites:
        folder = None if output is None else Path(output) / suite
        output_option = {} if folder is None else {"output_dir": str(folder)}
        status = max(status, evaluate(without(words, "env.task") | {"task": suite} | output_option))
        folders += [folder] if folder is not None and has_log(folder) else []
    if folders:
        (run,) = read_runs(folders)
        console().print(terminal_table(memory_types_table(run.summary)), crop=False)
    return status


def check_tasks(words: Mapping[str, str]) -> tuple[str, ...]:
    """Refuse unknown tasks before LeRobot is imported, which takes ten seconds; return the suites."""
    tasks = words.get("tasks") or words.get("env.tasks")
    task = words.get("task") or words.get("env.task")
    suite = words.get("suite") or words.get("env.suite") or PUBLISHED
    elsewhere = any(words.get(key) for key in (CONFIG_FILE, "task_dir", "env.task_dir"))
    ids = None if elsewhere else words.get("task_ids") or words.get("env.task_ids")
    with suppress(yaml.YAMLError):
        ids = yaml.safe_load(ids or "null")
    suites, tasks = lerobots_choice(task, ids, suite, "all" if tasks is None else tasks)
    if not elsewhere:
        for suite_name in suites:
            resolve_tasks(tasks, suite_name)
    return suites


def flags_of_other(words: Mapping[str, str]) -> list[str]:
    """Return LeRobot's flags for an evaluation of another environment than the benchmark."""
    from lerobot_memobench.policies.checkpoint import check_checkpoint

    for key in words:
        if key in RUN_OPTIONS:
            raise MemobenchError(f"{key}= belongs to the benchmark: name it with env=memobench")
    request = read_words("eval", words)
    passed_on = {key: words[key] for key in words if key == CONFIG_FILE or key.endswith(f".{PACKAGES}")}
    flags = [f"--{word}" for word in as_command_line({**passed_on, **request.words})]
    if HELP in words:
        return ["--help", *flags]
    if request.get(f"env.{TYPE}") is None and CONFIG_FILE not in words:
        raise MemobenchError("name an environment: env=memobench")
    if (path := request.get(f"policy.{PATH}")) is not None:
        check_checkpoint(path)
    return flags


def evaluate_here(plan: EvaluationPlan) -> int:
    """Run an evaluation, or a part of one, and print its report."""
    from lerobot_memobench.rollouts.evaluate import run_evaluation

    with counting(console(), "episodes") as count:
        report = run_evaluation(plan, note, say, count)
    if report is None:
        print(f"part {plan.options.shard} holds no episode: there are fewer batches than parts")
        return 0
    print_report(report)
    return 0


def evaluate_in_parts(plan: EvaluationPlan) -> int:
    """Run all parts of an evaluation as jobs, merge them and print the report; 1 when episodes are missing."""
    from lerobot_memobench.rollouts.shards import plan_shards, run_shards

    jobs = plan_shards(plan, SHARD_PROGRAM, note)
    with counting(console(), "parts", len(jobs)) as count:

        def advance(news: Advance) -> None:
            count(news.done, news.total, news.task_name, found=news.found)

        report = run_shards(plan, jobs, advance)
    return print_report(report)


def print_report(run: Run) -> int:
    """Print a report; return 1 when episodes that were asked for are missing."""
    from lerobot_memobench.evaluation.records import headline
    from lerobot_memobench.evaluation.report import REPORT_MARKDOWN, failure_line, rates_table
    from lerobot_memobench.evaluation.tables import terminal_table

    screen = console()
    screen.print()
    screen.print(headline([run]), style="bold")
    screen.print(terminal_table(rates_table(run.summary)), crop=False)
    screen.print(failure_line(run.summary))
    for line in run.notes:
        screen.print(f"note: {line}")
    print(f"report: {run.folder / REPORT_MARKDOWN}")
    return int(run.missing is not None)


# --- the process of one part ---


def end_with_the_parent() -> None:
    """End this process when its standard input closes: the process that started it has ended."""
    source = sys.stdin.fileno()

    def watch() -> None:
        while os.read(source, 1):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    typed = sys.argv[1:]
    if typed[:1] == [WITH_PARENT]:
        end_with_the_parent()
        typed = typed[1:]
    sys.exit(main(typed))
