"""``memobench doctor``: what is printed, and the exit status."""

from __future__ import annotations

import json

from rich.console import Console

from lerobot_memobench.cli.doctor import finding_table
from lerobot_memobench.doctor.findings import Finding, exit_status


def test_the_exit_status_and_the_table() -> None:
    findings = [Finding("a", "ok", "x"), Finding("b", "warning", "[y]", "do z")]
    assert exit_status(findings) == 0
    assert exit_status([*findings, Finding("c", "failed", "w", "v")]) == 1
    console = Console(width=80, record=True, quiet=False)
    with console.capture() as capture:
        console.print(finding_table(findings))
    assert "[y]" in capture.get()
    assert "do z" in capture.get()
    assert json.dumps([finding.as_dict() for finding in findings])
