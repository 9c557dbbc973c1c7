"""The command ``memobench``: everything that is not one of LeRobot's own commands.

Options are named as the functions they call name them. Modules that need LeRobot, torch or MuJoCo are
imported by the commands that use them, so that the others answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import typer

from lerobot_memobench.cli import controls, data, eyes, figures
from lerobot_memobench.cli.cache import cache
from lerobot_memobench.cli.demo import demo
from lerobot_memobench.cli.doctor import doctor
from lerobot_memobench.cli.generate import generate
from lerobot_memobench.cli.html import html
from lerobot_memobench.cli.learn import learn
from lerobot_memobench.cli.merge import merge, rerun
from lerobot_memobench.cli.necessity import necessity
from lerobot_memobench.cli.objects import objects
from lerobot_memobench.cli.recipe import recipe
from lerobot_memobench.cli.report import agreement, compare, report
from lerobot_memobench.cli.simulator import bench, gallery
from lerobot_memobench.cli.study import study
from lerobot_memobench.cli.tasks import tasks
from lerobot_memobench.errors import MemobenchError

__all__ = ["app", "main"]

USAGE_ERROR = 2

app = typer.Typer(
    name="memobench",
    help="MEMOBench: a process-level memory benchmark for robot manipulation, as a LeRobot plugin.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

COMMANDS: tuple[Callable[..., int | None], ...] = (
    tasks,
    objects,
    generate,
    cache,
    data.convert,
    data.validate,
    data.describe,
    data.push,
    recipe,
    study,
    learn,
    report,
    compare,
    agreement,
    html,
    necessity,
    merge,
    rerun,
    doctor,
    gallery,
    bench,
    demo,
)
"""In the order in which ``memobench --help`` lists them, before the groups."""

for command in COMMANDS:
    app.command()(command)
app.add_typer(figures.app, name="figures")
app.add_typer(controls.app, name="controls")
app.add_typer(eyes.app, name="eyes")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status. Errors a user can mend are one sentence on stderr, status
    2.
    """
    try:
        result = app(args=None if argv is None else list(argv), standalone_mode=False, prog_name="memobench")
    except MemobenchError as error:
        print(f"memobench: {' '.join(str(error).split())}", file=sys.stderr)
        return USAGE_ERROR
    except (typer.Abort, KeyboardInterrupt, EOFError):
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


if __name__ == "__main__":
    sys.exit(main())
