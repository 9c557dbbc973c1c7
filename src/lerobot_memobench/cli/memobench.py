"""The command ``memobench``: everything besides LeRobot's own commands.

Options have the names of the functions' parameters. Modules that need LeRobot, torch or MuJoCo are imported by the
commands that use them, so that the other commands start at once.
"""

from __future__ import annotations

import json
import shlex
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from lerobot_memobench.cli import data
from lerobot_memobench.cli.console import AsJson, SuiteOption, as_path, console, counting, note, run_app, say, table
from lerobot_memobench.cli.data import cache, generate
from lerobot_memobench.cli.report import compare, export, merge, report, rerun, submit
from lerobot_memobench.constants import SEALED
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.evaluation.tables import Unbroken
from lerobot_memobench.io import in_words
from lerobot_memobench.jobs.threads import ACTING, LEARNING, cores, use_threads
from lerobot_memobench.tasks.catalogue import (
    find_tasks,
    get_task,
    load_task,
    longest_cue_to_use,
    resolve_tasks,
    suite_of,
    task_folder,
    task_names,
    task_number,
    task_record,
)
from lerobot_memobench.tasks.task import LIBERO_SUITES, PUBLISHED, Task

if TYPE_CHECKING:
    from rich.table import Table

    from lerobot_memobench.doctor import Finding

COLOURS = {"ok": "green", "passed": "green", "failed": "red"}
"""Status of a finding of the doctor, or outcome of a conformance check -> its colour; others are yellow."""


# --- look around ---


def tasks(
    as_json: AsJson = False,
    suite: SuiteOption = PUBLISHED,
    folder: Annotated[
        Path | None, typer.Option("--dir", help="A task folder, or a folder of them, instead of the catalogue.")
    ] = None,
) -> int:
    """List the benchmark's tasks, or those of a folder."""
    listed = [get_task(name) for name in task_names(suite=suite)] if folder is None else list[Task]()
    problems: list[str] = []
    for path in [] if folder is None else find_tasks(folder):
        try:
            listed.append(load_task(path))
        except MemobenchError as error:
            problems.append(str(error))
    if not listed:
        raise MemobenchError(problems[0])
    if as_json:
        from lerobot_memobench.sim.simulation import Simulation

        records = []
        for task in listed:
            try:
                records.append(task_record(task, Simulation(task).state_dim))  # of the compiled model
            except MemobenchError as error:
                problems.append(f"{task.folder}: {error}")
        print(json.dumps(records, indent=1))
    else:
        console().print(Unbroken(task_table(listed), column=1), crop=False)
    for problem in problems:
        note(f"memobench: {problem}")
    return 1 if problems else 0


def task_table(tasks: Sequence[Task]) -> Table:
    """Return one row per task; ``tasks=`` and ``--tasks`` take the numbers, a user's own tasks have none.

    ``gap``: the longest of the task's checkpoints, control steps.
    """
    known = [suite_of(task.name) is not None and task.folder == task_folder(task.name) for task in tasks]
    suites = {task.suite if own else "" for task, own in zip(tasks, known, strict=True)}
    title = count_of(len(tasks), "task") + (f" of the {min(suites)} suite" if len(suites) == 1 and all(suites) else "")
    if suites <= {*LIBERO_SUITES}:  # without checkpoints and prompts
        rows = table("id", "task", "instruction", right=("id",), title=title)
        for task in tasks:
            rows.add_row(str(task_number(task.name)), task.name, task.language)
        return rows
    columns = ("no.", "task", "memory type", "checkpoints", "gap", "demonstration prompt", "instruction")
    rows = table(*columns, right=("no.", "gap"), title=title)
    for k, task in enumerate(tasks):
        if k and task.memory_type != tasks[k - 1].memory_type:
            rows.add_section()
        prompt = task.prompt.kind if task.prompt else ""
        gap = str(longest_cue_to_use(task) or "")
        number = str(task_number(task.name)) if known[k] else ""
        rows.add_row(number, task.name, task.memory_type, task.operations, gap, prompt, task.title)
    return rows


def objects(as_json: AsJson = False) -> None:
    """Print the layout of object observations. Slots, the fields of each, the classes by index."""
    from lerobot_memobench.sim.object_layout import SLOTS
    from lerobot_memobench.sim.object_slots import layout

    description = layout()
    if as_json:
        print(json.dumps(description, indent=1))
        return
    say(f"{SLOTS} slots, one after another; of each:")
    for field in description["fields"]:
        say(f"  {field['start']:>2}  {field['name']} ({field['size']})")
    say("classes: " + ", ".join(f"{k} {name}" for k, name in enumerate(description["classes"])))


def doctor(as_json: AsJson = False) -> int:
    """Check that this machine can run the benchmark. Each problem comes with its fix."""
    from lerobot_memobench.doctor import examine

    findings = examine()
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        console().print(finding_table(findings))
    return int(any(finding.status == "failed" for finding in findings))


def finding_table(findings: Sequence[Finding]) -> Table:
    """Return one row per finding, with the fix below the problem."""
    rows = table("checked", "", "found")
    for finding in findings:
        detail = Text(finding.detail)
        if finding.fix:
            detail.append("\nfix: ", "bold").append(finding.fix)
        rows.add_row(finding.what, Text(finding.status, COLOURS.get(finding.status, "yellow")), detail)
    return rows


def assets(
    to: Annotated[
        Path | None, typer.Option(help="Copy the files into this folder, for a machine without a network.")
    ] = None,
) -> None:
    """Find LIBERO's assets, which the scenes need. They are downloaded from the Hugging Face hub if this machine
    has no complete copy.
    """
    from lerobot_memobench.sim.files import ASSETS_VARIABLE, TERMS, copy_to, obtain

    place = obtain()
    say(f"LIBERO's assets: {place.folder}, from {place.source}. {TERMS}.")
    if to is not None:
        say(f"copied {in_words(copy_to(to))}; on the other machine, set {ASSETS_VARIABLE} to the copy of {to}")


def prepare(
    suite: SuiteOption = PUBLISHED,
    tasks: Annotated[str, typer.Option(help="all, memory types or task names, separated by commas.")] = "all",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core by default.")] = None,
) -> None:
    """Prepare this machine for its first episodes. Functions are compiled and the meshes of scenes are cached, on all
    cores.
    """
    from lerobot_memobench.sim.preparation import prepare as run

    names = resolve_tasks(tasks, suite)
    with counting(console(), "scenes", len(names)) as count:
        for done, name in enumerate(run(names, workers or cores()), 1):
            count(done, len(names), name)


# --- train ---


def recipe(name: Annotated[str | None, typer.Argument(help="A recipe; all are listed without it.")] = None) -> int:
    """Print the file of a training recipe. As in `lerobot-train --config_path=$(memobench recipe train_paper)`."""
    from lerobot_memobench.commands.command_line import recipe_file, recipes

    if name is not None:
        print(recipe_file(name))
        return 0
    rows = table("recipe", "trains")
    for key, path in recipes().items():
        rows.add_row(key, path.read_text().splitlines()[0].removeprefix("# "))
    console().print(rows)
    return 0


def conformance(
    settings: Annotated[
        list[str],
        typer.Argument(
            help="policy=…: a checkpoint folder, a policy of the package or of a plugin, or a type with settings "
            "policy.x=…; dataset=…: demonstrations as its inputs, made up when left out; obs_type=…",
            metavar="policy=…",
        ),
    ],
) -> int:
    """Check the memory of a policy. Rows are independent, reset forgets, the prompt reaches the memory, training has
    the history of a rollout, and more. Status 1 where a check fails.
    """
    from lerobot_memobench.conformance.checks import FAILED, run_checks
    from lerobot_memobench.conformance.subject import load_subject

    with tempfile.TemporaryDirectory() as folder:
        subject = load_subject(settings, Path(folder))
        results = run_checks(subject)
    rows = table("check", "outcome", "", title=f"Conformance of {subject.name}")
    for result in results:
        rows.add_row(result.check, Text(result.outcome, COLOURS.get(result.outcome, "yellow")), result.sentence)
    console().print(rows)
    failed = [result.check for result in results if result.outcome == FAILED]
    say(f"failed: {', '.join(failed)}" if failed else "No check failed.")
    return 1 if failed else 0


# --- results ---


def test_sealed(
    settings: Annotated[
        list[str],
        typer.Argument(help="As for `lerobot eval env=memobench`: policy=…, suite=…, tasks=….", metavar="policy=…"),
    ],
) -> int:
    """Evaluate on the sealed seeds. Seeds 100007 to 100056, once per release, when all settings are chosen. The card
    holds the salt, by which variants and holds can be drawn again.
    """
    from lerobot_memobench.cli.lerobot import run

    return run(["eval", "env=memobench", *settings, f"split={SEALED}"])


# --- the program ---

app = typer.Typer(
    name="memobench",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

COMMANDS: dict[str, tuple[Callable[..., int | None], ...]] = {
    "Look around": (tasks, objects, doctor, assets, prepare),
    "Demonstrations": (generate, data.convert, cache, data.view, data.validate, data.describe, data.push),
    "Train": (recipe, conformance),
    "Results": (test_sealed, report, compare, merge, rerun, submit, export),
}
"""Group -> its commands, as ``memobench --help`` lists them."""

RESUMED = ("generate", "cache", "convert", "push", "assets", "prepare")
"""Commands that continue when given again; any other starts over."""
LEARN = ("cache",)  # commands that train or encode in their own process; the others simulate, or compute little

for group, commands in COMMANDS.items():
    for command in commands:
        flags = {"ignore_unknown_options": command is test_sealed}  # it passes them to `lerobot eval`
        app.command(rich_help_panel=group, context_settings=flags)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"memobench {version('lerobot_policy_memobench')} (LeRobot {version('lerobot')})")
        raise typer.Exit


@app.callback(epilog="Evaluations and training are LeRobot's commands: `lerobot eval --help`, `lerobot train --help`.")
def options(
    shown: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """MEMOBench: a process-level memory benchmark for robot manipulation, as a LeRobot plugin."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    words = [as_path(word) for word in (sys.argv[1:] if argv is None else argv)]
    use_threads(LEARNING if words and words[0] in LEARN else ACTING)  # before torch is imported
    verb = "resume" if words and words[0] in RESUMED else "start again"
    return run_app(app, words, "memobench", f"{verb} with: {shlex.join(['memobench', *words])}")


if __name__ == "__main__":
    sys.exit(main())
