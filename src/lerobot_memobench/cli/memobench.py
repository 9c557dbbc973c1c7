"""The command ``memobench``: everything that is not one of LeRobot's own commands.

Options are named as the functions they call name them. Modules that need LeRobot, torch or MuJoCo are
imported by the commands that use them, so that the others answer at once.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lerobot_memobench.cli import data
from lerobot_memobench.cli.conformance import conformance
from lerobot_memobench.cli.console import run_app
from lerobot_memobench.cli.data import cache, generate
from lerobot_memobench.cli.doctor import doctor
from lerobot_memobench.cli.report import compare, merge, report, rerun
from lerobot_memobench.cli.sealed import test_sealed
from lerobot_memobench.cli.tasks import objects, recipe, tasks
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import as_path
from lerobot_memobench.jobs.threads import ACTING, LEARNING, use_threads

__all__ = ["app", "main"]


class Grouped(TyperGroup):
    """Commands listed under what they are for."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section per panel, in the order of the commands."""
        found = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        shown = [(name, one) for name, one in found if one is not None and not one.hidden]
        width, names = formatter.width - 6, max(len(name) for name, _ in shown)
        for panel in dict.fromkeys(getattr(one, "rich_help_panel", None) for _, one in shown):
            members = [(name, one) for name, one in shown if getattr(one, "rich_help_panel", None) == panel]
            with formatter.section(str(panel)):
                formatter.write_dl(
                    [(name.ljust(names), one.get_short_help_str(width - names)) for name, one in members]
                )


app = typer.Typer(
    name="memobench",
    cls=Grouped,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

COMMANDS: dict[str, tuple[Callable[..., int | None], ...]] = {
    "Look around": (tasks, objects, doctor),
    "Demonstrations": (generate, data.convert, cache, data.view, data.validate, data.describe, data.push),
    "Train": (recipe, conformance),
    "Results": (test_sealed, report, compare, merge, rerun),
}
"""Group -> its commands, as ``memobench --help`` lists them."""

GO_ON = ("generate", "cache", "convert", "push")
"""Commands that continue when given again; any other starts over."""
LEARN = ("cache",)
"""Commands whose own process trains or encodes; every other simulates, or computes next to nothing."""

for group, commands in COMMANDS.items():
    for command in commands:
        flags = {"ignore_unknown_options": command is test_sealed}  # which hands them to LeRobot
        app.command(rich_help_panel=group, context_settings=flags)(command)


ELSEWHERE = {
    "eval": "lerobot eval env=memobench policy=CHECKPOINT tasks=object",
    "train": "lerobot train policy=memobench_mem dataset=FOLDER",
    "html": "memobench report FOLDER --html OUT",
    "figures": "memobench report FOLDER --figures OUT; the paper's: python examples/paper_figures.py",
    "controls": "memobench compare A B; of evidence and granularity: memobench report A B",
    "demo": "make demo",
    "gallery": "python scripts/gallery.py --out FOLDER",
}
"""Commands of LeRobot's and of earlier releases -> the command to give instead."""


def _refuse(name: str) -> None:
    """Make ``memobench <name>`` an error that names the command to give instead."""

    def refuse(words: Annotated[list[str] | None, typer.Argument()] = None) -> None:
        raise MemobenchError(f"`memobench` has no command {name!r}; give: {ELSEWHERE[name]}")

    app.command(name, hidden=True, add_help_option=False, context_settings={"ignore_unknown_options": True})(refuse)


for name in ELSEWHERE:
    _refuse(name)


def _say_version(wanted: bool) -> None:
    if wanted:
        print(f"memobench {version('lerobot_policy_memobench')} (LeRobot {version('lerobot')})")
        raise typer.Exit


@app.callback(epilog="Evaluations and training are LeRobot's commands: `lerobot eval --help`, `lerobot train --help`.")
def options(
    shown: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_say_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """MEMOBench: a process-level memory benchmark for robot manipulation, as a LeRobot plugin."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    words = [as_path(word) for word in (sys.argv[1:] if argv is None else argv)]
    use_threads(LEARNING if words and words[0] in LEARN else ACTING)
    begins = "go on" if words and words[0] in GO_ON else "begin anew"
    again = f"{begins} with: {shlex.join(['memobench', *words])}"
    return run_app(app, words, "memobench", again)


if __name__ == "__main__":
    sys.exit(main())
