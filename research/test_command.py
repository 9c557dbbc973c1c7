"""A study's command: errors and help."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from research.command import run


def test_errors_are_one_line_with_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    def command(number: int) -> None:
        raise MemobenchError(f"found {number},\nexpected none")

    assert run("none", command, ["3"]) == 2
    assert capsys.readouterr().err == "python -m research.none: found 3, expected none\n"
    assert run("none", command, ["x"]) == 2
    assert "(see `python -m research.none --help`)" in capsys.readouterr().err
    assert run("none", command, ["--help"]) == 0
