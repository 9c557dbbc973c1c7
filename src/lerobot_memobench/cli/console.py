"""Output shared by the commands: tables, progress, errors; and their common options."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from http.client import HTTPException
from typing import Annotated, Any, Literal
from urllib.error import URLError

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from lerobot_memobench.errors import MemobenchError, came_through, chain
from lerobot_memobench.io import disk_refusal
from lerobot_memobench.jobs.processes import adding_resume_hint, lock_refusal, prepare_process, reader_has_left
from lerobot_memobench.tasks.task import LiberoSuite, Suite

USAGE_ERROR = 2

WIDTH_OF_A_FILE = 140  # columns where the output is no terminal: task names are long, and a log file has no edge
SPEED_PERIOD = 600.0  # seconds over which speed is averaged: some tasks take several times as long as others

AnySuite = Literal[Suite, LiberoSuite]
SuiteOption = Annotated[
    AnySuite,
    typer.Option(
        help="published: the thirty tasks as published; strict: their memory-necessary variants, whose answer no "
        "image shows; libero_…: LIBERO's own."
    ),
]
Workers = Annotated[int, typer.Option(min=1, help="Processes.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def console() -> Console:
    """Return a console as wide as the terminal, or wide enough for the tables where there is none.

    It prints brackets as they are, since texts come from files.
    """
    return Console(width=None if sys.stdout.isatty() else WIDTH_OF_A_FILE, highlight=False, markup=False)


def table(*columns: str, right: Collection[str] = (), **settings: Any) -> Table:
    """Return a table without rows; columns of numbers are flush ``right``."""
    result = Table(header_style="bold", pad_edge=False, title_justify="left", **settings)
    for name in columns:
        result.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return result


def say(text: object) -> None:
    """Print a line, however long."""
    console().print(str(text), soft_wrap=True)


def note(text: str) -> None:
    """Print a message on stderr."""
    print(text, file=sys.stderr)


def as_path(word: str) -> str:
    """Return a word of a command line with a path that every library recognises.

    A leading ``~/`` is expanded, which shells do not do in quotes or, some of them, after ``key=``. An existing path
    with a colon becomes absolute, because Arrow and FFmpeg read ``run: 2`` as an address.
    """
    start, path = word.split("=", 1) if "=" in word else ("", word)
    if path.startswith("~/"):
        path = os.path.expanduser(path)
    elif ":" in path and os.path.exists(path):
        path = os.path.abspath(path)
    return f"{start}={path}" if "=" in word else path


class Count:
    """Progress of a run: a bar on a terminal, a line for each piece of work in a file, both with the time left."""

    def __init__(self, progress: Progress, unit: str, total: int | None) -> None:
        self._progress, self._bar = progress, progress.add_task(unit, total=total)

    def __call__(self, done: int, total: int, what: str = "", *, trouble: str | None = None, found: int = 0) -> None:
        """Show that ``done`` of ``total`` pieces of work are done, ``found`` of them by an earlier run.

        ``what``: name of the newest piece; "" prints no line. ``trouble``: its failure, printed on a terminal as well.
        """
        if done <= found:  # they are left out of the speed
            self._progress.reset(self._bar, total=total, completed=done)
        else:
            self._progress.update(self._bar, total=total, completed=done)
        screen = self._progress.console
        if trouble is not None:
            screen.print(f"{what}: {trouble}", soft_wrap=True, markup=False)
        elif screen.is_terminal or not what:
            return
        elif done <= found:
            if done == found:
                screen.print(f"{found}/{total} were done earlier")
        else:
            screen.print(f"{done}/{total} {what}{self._left()}", soft_wrap=True, markup=False)

    def _left(self) -> str:
        seconds = self._progress.tasks[self._bar].time_remaining
        return f", {timedelta(seconds=round(seconds))} left" if seconds else ""


@contextmanager
def counting(screen: Console, unit: str, total: int | None = None) -> Iterator[Count]:
    """Show the progress of a run; call the yielded `Count` after every piece of work."""
    bar = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    columns = (*bar, TimeElapsedColumn(), TimeRemainingColumn())
    quiet = not screen.is_terminal
    with Progress(*columns, console=screen, disable=quiet, speed_estimate_period=SPEED_PERIOD) as progress:
        yield Count(progress, unit, total)


FETCHING = (URLError, HTTPException, ConnectionError, TimeoutError)  # errors of torch where it cannot fetch weights


def run_app(app: typer.Typer, arguments: Sequence[str], program: str, again: str) -> int:
    """Run the commands of an app as `run_command` does."""
    # In standalone mode click would print errors and end the process.
    call = partial(app, args=list(arguments), standalone_mode=False, prog_name=program)
    return run_command(call, program, again)


def run_command(call: Callable[[], object], program: str, again: str) -> int:
    """Run a command; return the exit status. A user's mistake is one line on stderr, status 2.

    ``again``: how to resume, printed when SIGTERM ends it or a worker process is killed.
    """
    try:
        prepare_process()
        with adding_resume_hint(program, lambda: again):
            result = call()
            sys.stdout.flush()  # here, not when Python exits, so that its errors become a sentence too
    except (typer.Abort, KeyboardInterrupt):
        return 130  # as shells do after Ctrl-C
    except typer.Exit as stop:
        return stop.exit_code
    except Exception as error:
        if isinstance(error, BrokenPipeError) and reader_has_left():
            return 1
        # Newer typer contains its own copy of click, so click's usage errors are recognised by their method.
        message: Callable[[], str] | None = getattr(error, "format_message", None)
        if message is not None and type(error).__name__ == "NoArgsIsHelpError":  # a group without a command: its help
            print(message())
            return 0
        sentence = one_sentence(error) if message is None else f"{message()} (see `{program} --help`)"
        if sentence is None:
            raise
        print(f"{program}: {sentence}", file=sys.stderr)
        return int(getattr(error, "exit_code", USAGE_ERROR))
    return result if isinstance(result, int) else 0


def one_sentence(error: BaseException) -> str | None:
    """Return the message for the user in one line, or None for a failure that needs its traceback."""
    errors = list(chain(error))
    for cause in errors:
        if isinstance(cause, MemobenchError):
            return _line(cause)
    from draccus.utils import ParsingError

    if isinstance(error, ParsingError):
        # draccus hides the message of a configuration's own check behind "couldn't instantiate".
        return _line(next((e for e in reversed(errors) if isinstance(e, ValueError | TypeError)), error))
    extra = isinstance(error, ImportError) and "required but not installed" in str(error)  # of LeRobot
    if extra or isinstance(error, FileExistsError):
        return _line(error)
    if refusal := lock_refusal(error):
        return refusal
    if refusal := disk_refusal(error):
        filename = next((cause.filename for cause in errors if isinstance(cause, OSError) and cause.filename), None)
        where = f"{os.fsdecode(filename)} " if isinstance(filename, str | bytes) else ""
        return f"{where}cannot be written ({refusal}): make room, or name another folder"
    fetched = next((cause for cause in errors if isinstance(cause, FETCHING)), None)
    if fetched is not None and came_through(fetched, "torch.hub"):
        return (
            f"the pretrained weights of a backbone are not on this machine and could not be fetched "
            f"({_line(fetched)[:200]}); policy.pretrained_backbone_weights=null begins with random ones, which a "
            "checkpoint replaces"
        )
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled

    of_hub = (HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled, httpx.TransportError)
    hub = next((cause for cause in errors if isinstance(cause, of_hub)), None)
    if hub is None:
        return None
    reason = f"{_address(errors)}{_line(hub)[:200]}"
    if any(came_through(cause, "lerobot.datasets.") for cause in errors):
        return (
            f"the dataset is not on this machine and could not be fetched from the hub ({reason}); name a folder on "
            "this machine, dataset=<folder>, or make one: `memobench generate --tasks object --episodes 5 --out "
            "outputs/demonstrations`, then dataset=outputs/demonstrations"
        )
    return (
        f"a repository is not on this machine and could not be fetched from the hub ({reason}); name a folder on this "
        "machine: dataset=<folder> or policy=<folder>"
    )


def _address(errors: Sequence[BaseException]) -> str:
    """Return the address that the hub was asked for and a colon, "" where it is not known. It shows a misspelling."""
    for error in errors:
        with suppress(AttributeError, RuntimeError):  # not an error of httpx, or raised before the request
            return f"{error.request.url}: "  # type: ignore[attr-defined]
        if offline := re.search(r"Cannot reach (\S+): ", str(error)):
            return f"{offline[1]}: "
    return ""


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
