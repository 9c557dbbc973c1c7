"""A study as a command: ``python -m research.<name>``."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable

import typer

from lerobot_memobench.cli.console import one_sentence
from lerobot_memobench.jobs.processes import saying_how_to_go_on
from lerobot_memobench.jobs.threads import ACTING, LEARNING, use_threads

USAGE_ERROR = 2


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
    again = f"{program}: ended by SIGTERM; go on with: {program} {shlex.join(arguments)}"
    try:
        with saying_how_to_go_on(lambda: again):
            app(args=arguments, standalone_mode=False, prog_name=program)
    except (typer.Abort, KeyboardInterrupt, EOFError):
        return 130
    except typer.Exit as stop:
        return stop.exit_code
    except Exception as error:
        message: Callable[[], str] | None = getattr(error, "format_message", None)  # click's usage errors
        sentence = one_sentence(error) if message is None else f"{message()} (see `{program} --help`)"
        if sentence is None:
            raise
        print(f"{program}: {sentence}", file=sys.stderr)
        return USAGE_ERROR
    return 0
