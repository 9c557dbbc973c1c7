"""A study as a command: ``python -m research.<name>``."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable

import typer

from lerobot_memobench.cli.console import run_app
from lerobot_memobench.jobs.threads import ACTING, LEARNING, use_threads


def run(name: str, command: Callable[..., None], argv: list[str] | None = None, *, learns: bool = False) -> int:
    """Run a study's command; return the exit status.

    Errors a user can mend are one sentence on stderr, status 2.

    Args:
        name: as in ``python -m research.<name>``.
        command: its parameters are the options.
        argv: arguments; None for those of the process.
        learns: whether this process trains, which may take more threads than simulating.
    """
    arguments = sys.argv[1:] if argv is None else argv
    use_threads(LEARNING if learns else ACTING)
    program = f"python -m research.{name}"
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(command)
    again = f"go on with: {program} {shlex.join(arguments)}"
    return run_app(app, arguments, program, again)
