"""The command ``lerobot``: ``lerobot <name> key=value …`` runs LeRobot's own ``lerobot-<name>``.

``key=value`` becomes ``--key=value`` after a check against the command's settings; whatever starts with
``--`` is passed on untouched. ``lerobot eval env=memobench`` and ``lerobot train policy=…`` also get the
benchmark's defaults (``run.plan``, ``training.command``).
"""

from __future__ import annotations

import os
import shlex
import sys
import threading
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from lerobot_memobench.cli.console import WITH_PARENT, run_command, tell
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.io import as_path
from lerobot_memobench.jobs.threads import ACTING, use_threads
from lerobot_memobench.run.arguments import (
    SHORT_FORMS,
    check_task_names,
    is_of_benchmark,
    read_arguments,
    split_arguments,
)
from lerobot_memobench.run.lerobot_commands import call_lerobot, lerobot_commands


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    line = [as_path(word) for word in (sys.argv[1:] if argv is None else argv)]
    again = f"begin anew with: {shlex.join(['lerobot', *line])}"
    return run_command(partial(run, line), "lerobot", again)


def run(line: Sequence[str]) -> int:
    """Run the command line."""
    commands = lerobot_commands()
    if not line or line[0] in ("-h", "--help", "help"):
        print(overview(commands))
        return 0
    name, given = line[0], split_arguments(line[1:])
    if name not in commands:
        raise MemobenchError(f"there is no command {name!r}, {nearest(name, commands)}")
    if given.wants_help and name in SHORT_FORMS:
        print(Path(__file__).with_name(f"lerobot_{name}.txt").read_text(), flush=True)
    if name == "train":
        from lerobot_memobench.training.command import train

        return train(given, line[1:], tell)
    check_task_names(given)
    if name == "eval":
        use_threads(ACTING)  # before torch is imported
        from lerobot_memobench.cli.evaluate import evaluate, evaluate_elsewhere

        ours = is_of_benchmark(given) and not given.wants_help
        return evaluate(given, ("lerobot", *line)) if ours else evaluate_elsewhere(given)
    return call_lerobot(name, read_arguments(name, given).for_parser)


def overview(commands: Iterable[str]) -> str:
    """Return the help of ``lerobot`` itself."""
    return "\n".join(
        [
            "usage: lerobot <command> key=value … [--flag=value …]",
            "",
            "  lerobot eval env=memobench                                   the scripted expert on all tasks",
            "  lerobot eval env=memobench policy=<checkpoint> tasks=object  a trained policy",
            "  lerobot train policy=memobench_mem align=contrastive dataset=<folder>",
            "  lerobot train config=train_paper dataset=<folder>            the paper's recipe (memobench recipe)",
            "",
            "`lerobot eval --help` and `lerobot train --help` explain these short forms; any other setting goes by its",
            "full name (policy.optimizer_lr=1e-4), as listed there.",
            "",
            "commands: " + ", ".join(sorted(commands)),
        ]
    )


def end_with_the_parent() -> None:
    """End this process when standard input closes: the process that wanted a part of an evaluation is gone."""
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
