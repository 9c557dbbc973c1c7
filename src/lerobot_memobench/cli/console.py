"""Where the commands print to."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

#: Columns when the output is no terminal: task names are long, and a log file has no edge.
WIDTH_OF_A_FILE = 140

#: Seconds of a run that say how fast it goes on: some tasks take several times as long as others.
SPEED_PERIOD = 600.0


def console() -> Console:
    """Return a console as wide as the terminal, or wide enough for the tables where there is none.

    What stands in brackets is printed as it is: most of it comes out of files.
    """
    return Console(width=None if sys.stdout.isatty() else WIDTH_OF_A_FILE, highlight=False, markup=False)


class Count:
    """How far a run is: a bar on a terminal, a line for each piece of work in a file, both with the time left."""

    def __init__(self, progress: Progress, unit: str, total: int | None) -> None:
        self._progress, self._bar = progress, progress.add_task(unit, total=total)

    def __call__(self, done: int, total: int, what: str = "", *, trouble: str | None = None, found: int = 0) -> None:
        """Say that ``done`` of ``total`` are done.

        Args:
            done, total: pieces of work.
            what: the newest one; "" prints nothing.
            trouble: what is wrong with it, printed on a terminal as well.
            found: how many of those done are an earlier run's: they say nothing about the speed of this one.
        """
        if done <= found:
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
                screen.print(f"{found}/{total} are there already")
        else:
            screen.print(f"{done}/{total} {what}{self._left()}", soft_wrap=True, markup=False)

    def _left(self) -> str:
        seconds = self._progress.tasks[self._bar].time_remaining
        return f", {timedelta(seconds=round(seconds))} left" if seconds else ""


@contextmanager
def counting(screen: Console, unit: str, total: int | None = None) -> Iterator[Count]:
    """Show how far a run is while the context lasts; what it yields is told of every piece of work."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    quiet = not screen.is_terminal
    with Progress(*columns, console=screen, disable=quiet, speed_estimate_period=SPEED_PERIOD) as progress:
        yield Count(progress, unit, total)
