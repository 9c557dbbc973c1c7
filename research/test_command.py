"""A study's command: errors, and the end of a job."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from research.command import run

ROOT = Path(__file__).parents[1]


def test_what_a_user_can_mend_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    def command(number: int) -> None:
        raise MemobenchError(f"found {number},\nexpected none")

    assert run("none", command, ["3"]) == 2
    assert capsys.readouterr().err == "python -m research.none: found 3, expected none\n"
    assert run("none", command, ["x"]) == 2
    assert "(see `python -m research.none --help`)" in capsys.readouterr().err
    assert run("none", command, ["--help"]) == 0


@pytest.mark.slow
def test_a_job_that_is_ended_says_how_to_go_on(tmp_path: Path) -> None:
    out = tmp_path / "bowl"
    arguments = ["bowl", "--out", str(out), "--episodes", "20", "--workers", "2"]
    words = [sys.executable, "-m", "research.learning", *arguments]
    with subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) as job:
        while not any(out.rglob(".staging/*/*/*")):
            assert job.poll() is None
            time.sleep(0.1)
        job.send_signal(signal.SIGTERM)
        _, said = job.communicate(timeout=60)
    program = "python -m research.learning"
    assert said.endswith(f"{program}: ended by SIGTERM; go on with: {program} {shlex.join(arguments)}\n")
