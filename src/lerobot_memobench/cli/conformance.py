"""``memobench conformance``: whether a policy remembers as it should."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from lerobot_memobench.cli.console import console, say

COLOURS = {"passed": "green", "failed": "red", "no memory": "yellow", "not checked": "yellow"}


def conformance(
    settings: Annotated[
        list[str],
        typer.Argument(
            help="policy=…: a checkpoint folder, a policy of the package or of a plugin, or a type with settings "
            "policy.x=…; dataset=…: demonstrations to drive it with, made up where none are named; obs_type=…",
            metavar="policy=…",
        ),
    ],
) -> int:
    """Check that a policy remembers as it should. Rows are independent, reset forgets, the prompt reaches the memory,
    training has the history of a rollout, and more. Status 1 where a check fails.
    """
    import tempfile
    from pathlib import Path

    from lerobot_memobench.conformance.checks import Outcome, run_checks
    from lerobot_memobench.conformance.subject import load_subject

    with tempfile.TemporaryDirectory() as folder:
        subject = load_subject(settings, Path(folder))
        results = run_checks(subject)
    table = Table("check", "outcome", "", title=f"Conformance of {subject.name}", title_justify="left")
    for result in results:
        table.add_row(result.check, Text(result.outcome, COLOURS[result.outcome]), result.sentence)
    console().print(table)
    failed = [result.check for result in results if result.outcome is Outcome.FAILED]
    say(f"failed: {', '.join(failed)}" if failed else "No check failed.")
    return 1 if failed else 0
