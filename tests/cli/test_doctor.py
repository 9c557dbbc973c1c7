"""``memobench doctor``: what is printed, and the exit status."""

from __future__ import annotations

import json

from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.demo import finding_table
from lerobot_memobench.doctor.examination import Finding, exit_status


def test_the_exit_status_and_the_table() -> None:
    findings = [Finding("a", "ok", "x"), Finding("b", "warning", "[y]", "do z")]
    assert exit_status(findings) == 0
    assert exit_status([*findings, Finding("c", "failed", "w", "v")]) == 1
    screen = console()
    with screen.capture() as capture:
        screen.print(finding_table(findings))
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capture.get().splitlines() if "│" in line]
    assert rows == [["a", "ok", "x"], ["b", "warning", "[y]"], ["", "", "fix: do z"]]
    assert json.dumps([finding.as_dict() for finding in findings])
