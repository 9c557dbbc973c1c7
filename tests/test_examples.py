"""The examples run."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.run.arguments import read_arguments, split_arguments
from lerobot_memobench.run.plan import take_run_options

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_every_command_is_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings that the example types are those of today; nothing is run."""
    typed: list[list[str]] = []

    class Done:
        returncode = 0

        def __init__(self, command: list[str], **_: Any) -> None:
            typed.append([Path(command[0]).name, *command[1:]])

        def wait(self) -> int:
            return 0

    monkeypatch.setattr(sys, "argv", ["train_in_ten_minutes.py", "--out", str(tmp_path)])
    monkeypatch.setattr(subprocess, "run", Done)
    monkeypatch.setattr(subprocess, "Popen", Done)
    runpy.run_path(str(EXAMPLES / "train_in_ten_minutes.py"), run_name="__main__")
    (tmp_path / "data").mkdir()
    trainings = [line for command, verb, *line in typed if (command, verb) == ("lerobot", "train")]
    fusions = [read_arguments("train", split_arguments(line)).get("policy.memory_fusion") for line in trainings]
    assert fusions == [None, "none"]
    evaluations = [line for command, verb, *line in typed if (command, verb) == ("lerobot", "eval")]
    for line in evaluations:
        take_run_options(split_arguments([word for word in line if not word.startswith("policy=")]))
    assert len(evaluations) == 2


@pytest.mark.slow
def test_ten_minutes(tmp_path: Path) -> None:
    words = [sys.executable, EXAMPLES / "train_in_ten_minutes.py", "--smoke", "--out", tmp_path]
    done = subprocess.run(words, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    for name in ("memory", "no_memory"):
        assert json.loads((tmp_path / f"{name}_rollouts" / "report.json").read_text())["average"]["n"] == 1
    assert "no_memory_rollouts against memory_rollouts" in done.stdout
    # Given again, only what ends well by itself is done again.
    trained = (tmp_path / "memory" / "checkpoints" / "last").stat().st_mtime
    assert subprocess.run(words, capture_output=True, timeout=500).returncode == 0
    assert (tmp_path / "memory" / "checkpoints" / "last").stat().st_mtime == trained
