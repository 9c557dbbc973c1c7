"""The examples run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


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
