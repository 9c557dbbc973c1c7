"""``memobench doctor``: whether this machine can run the benchmark."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from lerobot_memobench.cli.console import console

if TYPE_CHECKING:
    from lerobot_memobench.doctor.examination import Finding, Status

COLOURS: dict[Status, str] = {"ok": "green", "warning": "yellow", "failed": "red"}


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> int:
    """Check that this machine can run the benchmark. Each problem comes with its fix."""
    from lerobot_memobench.doctor.examination import examine, exit_status

    findings = examine()
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        console().print(finding_table(findings))
    return exit_status(findings)


def finding_table(findings: Sequence[Finding]) -> Table:
    """Return one row per finding, the fix under what it mends."""
    table = Table(header_style="bold", pad_edge=False, show_lines=False)
    for name in ("checked", "", "found"):
        table.add_column(name, overflow="fold")
    for finding in findings:
        found = Text(finding.detail)
        if finding.fix:
            found.append("\nfix: ", "bold").append(finding.fix)
        table.add_row(finding.what, Text(finding.status, COLOURS[finding.status]), found)
    return table
