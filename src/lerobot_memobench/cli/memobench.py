"""The command ``memobench``: the benchmark's tasks, demonstrations, memory cache, reports, and the state of
this machine.

Options are named as the functions they call name them. Modules that need LeRobot, torch or MuJoCo are
imported by the commands that use them, so that the others answer at once.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from lerobot_memobench.cli import controls, data, figures, html, merging, report
from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.recipes import recipe
from lerobot_memobench.cli.study import study
from lerobot_memobench.errors import MemobenchError

USAGE_ERROR = 2

app = typer.Typer(
    name="memobench",
    help="MEMOBench: a process-level memory benchmark for robot manipulation, as a LeRobot plugin.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status. Errors a user can mend are one sentence on stderr, status
    2.
    """
    try:
        result = app(args=None if argv is None else list(argv), standalone_mode=False, prog_name="memobench")
    except MemobenchError as error:
        print(f"memobench: {' '.join(str(error).split())}", file=sys.stderr)
        return USAGE_ERROR
    except typer.Abort:
        return 130
    except (KeyboardInterrupt, EOFError):
        return 130
    except typer.Exit as stop:
        return stop.exit_code
    except Exception as error:
        message: Callable[[], str] | None = getattr(error, "format_message", None)  # click's usage errors
        if message is None:
            raise
        print(f"memobench: {message()} (see `memobench --help`)", file=sys.stderr)
        return int(getattr(error, "exit_code", USAGE_ERROR))
    return result if isinstance(result, int) else 0


class Referent(StrEnum):
    """What the goal of object and procedural tasks is."""

    FIXED = "fixed"
    RANDOM = "random"


class Format(StrEnum):
    """What demonstrations are written as."""

    LEROBOT = "lerobot"
    HDF5 = "hdf5"


class Executor(StrEnum):
    """What runs the episodes."""

    PROCESSES = "processes"
    LOCAL = "local"
    SLURM = "slurm"
    RAY = "ray"


# --- tasks ---


@app.command()
def tasks(
    as_json: Annotated[bool, typer.Option("--json", help="Print everything about each task as JSON.")] = False,
    folder: Annotated[
        Path | None,
        typer.Option("--dir", help="A task folder, or a folder of them, instead of the catalogue."),
    ] = None,
) -> int:
    """List the benchmark's tasks, or those of a folder."""
    from lerobot_memobench.cli.tasks import load_tasks, records, task_table

    found, problems = load_tasks(folder)
    if as_json:
        print(json.dumps(records(found), indent=1))
    else:
        console().print(task_table(found))
    for problem in problems:
        print(f"memobench: {problem}", file=sys.stderr)
    return 1 if problems else 0


# --- demonstrations ---


@app.command()
def generate(
    out: Annotated[Path, typer.Option(help="Folder of the dataset that is made.")],
    tasks: Annotated[str, typer.Option(help="all, memory types or task names, separated by commas.")] = "all",
    episodes: Annotated[int, typer.Option(min=1, help="Demonstrations per task.")] = 50,
    seed_base: Annotated[int, typer.Option(help="Demonstration i uses the seed seed_base + i.")] = 10_000,
    referent: Annotated[
        Referent, typer.Option(help="fixed: the catalogue's goal; random: the seed decides.")
    ] = Referent.FIXED,
    images: Annotated[bool, typer.Option(help="Record both cameras.")] = True,
    image_size: Annotated[int, typer.Option(min=16, help="Height and width of the images, pixels.")] = 256,
    prompt_video: Annotated[bool, typer.Option(help="Begin with the prompt where a task has one.")] = True,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    repo_id: Annotated[str | None, typer.Option(help="Name of the dataset, user/name.")] = None,
    formats: Annotated[
        list[Format] | None, typer.Option("--format", help="lerobot (default), hdf5, or both by naming both.")
    ] = None,
    executor: Annotated[
        Executor, typer.Option(help="processes here, or datatrove's: local, slurm, ray.")
    ] = Executor.PROCESSES,
    executor_option: Annotated[
        list[str] | None, typer.Option(help="key=value for datatrove's executor, e.g. partition=cpu; repeatable.")
    ] = None,
) -> int:
    """Let the scripted experts make demonstrations into a LeRobotDataset. The same command continues a killed
    run.
    """
    from lerobot_memobench.cli.generate import generate as run

    return run(
        tasks,
        episodes,
        out,
        seed_base=seed_base,
        referent=referent.value,
        images=images,
        image_size=image_size,
        prompt_video=prompt_video,
        workers=workers,
        formats=tuple(format_.value for format_ in formats or [Format.LEROBOT]),
        executor=executor.value,
        executor_options=data.executor_options(executor_option or []),
        **({} if repo_id is None else {"repo_id": repo_id}),
    )


@app.command()
def cache(
    dataset: Annotated[Path, typer.Argument(help="Folder of a LeRobotDataset with the benchmark's columns.")],
    size: Annotated[str, typer.Option(help="Size of the policy that reads it: tiny or pi05.")] = "tiny",
    stride: Annotated[int, typer.Option(min=1, help="Keep every how many frames (policy.memory_stride).")] = 1,
    weights: Annotated[
        str | None, typer.Option(help="Folder or repository whose image tower is used (size pi05).")
    ] = None,
    device: Annotated[str | None, typer.Option(help="cuda or cpu; the best there is by default.")] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Frames per pass of the image tower.")] = 64,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Threads that decode videos; as many as there are cores by default.")
    ] = None,
) -> None:
    """Encode a dataset's frames and subgoals once, for policies with a memory."""
    from lerobot_memobench.cli.generate import cache as run

    run(dataset, size=size, stride=stride, weights=weights, device=device, batch_size=batch_size, workers=workers)


app.command()(data.convert)
app.command()(data.validate)
app.command()(data.describe)
app.command()(data.push)
app.command()(recipe)
app.command()(study)


# --- reports ---


app.command()(report.report)
app.command()(report.compare)
app.command()(report.agreement)
app.add_typer(figures.app, name="figures")
app.command()(html.html)
app.command()(controls.necessity)
app.add_typer(controls.app, name="controls")


app.command()(merging.merge)
app.command()(merging.rerun)


# --- this machine ---


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> int:
    """Check that this machine can run the benchmark, and say how to mend what it cannot."""
    from lerobot_memobench.cli.doctor import examine, exit_status, finding_table

    findings = examine()
    if as_json:
        print(json.dumps([finding.as_dict() for finding in findings], indent=1))
    else:
        console().print(finding_table(findings))
    return exit_status(findings)


@app.command()
def gallery(
    out: Annotated[Path, typer.Option(help="Folder of the pictures; those of the same name are replaced.")] = Path(
        "outputs/gallery"
    ),
) -> None:
    """Draw every task's initial scene, every object from all sides, every fixture open and closed."""
    from lerobot_memobench.sim.gallery import write_gallery

    for picture in write_gallery(out):
        console().print(str(picture), soft_wrap=True)


@app.command()
def bench(
    names: Annotated[list[str] | None, typer.Argument(help="Which benchmarks; all when left out.")] = None,
) -> None:
    """Time steps, resets and workers against stock robosuite, in one run; the table belongs in a bug report."""
    from lerobot_memobench.bench.claims import run
    from lerobot_memobench.bench.line import table

    lines = []
    for line in run(names):
        print(line.json(), flush=True)
        lines.append(line)
    print(f"\n{table(lines)}")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder of videos and report; an earlier demo there is replaced.")] = Path(
        "outputs/demo"
    ),
) -> int:
    """Evaluate the scripted expert on four tasks, one of each memory type, and show it in videos."""
    from lerobot_memobench.cli.demo import run_demo

    return run_demo(out)


__all__: list[Any] = ["app", "main"]
