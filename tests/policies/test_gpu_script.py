"""``benchmarks/gpu.py`` on a CPU prints a table and resumes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_parts_are_measured_once(tmp_path: Path) -> None:
    out = tmp_path / "gpu.jsonl"
    parts = ["equal", "plan", "update", "update, DDP of one"]
    command = [sys.executable, "benchmarks/gpu.py", "--size", "tiny", "--device", "cpu", "--steps", "1"]
    command += ["--minutes", "60", "--out", str(out), "--parts"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), *sys.path])}

    def ran(*parts: str) -> list[str]:
        done = subprocess.run([*command, *parts], cwd=ROOT, env=environment, check=True, capture_output=True, text=True)
        return done.stdout.splitlines()

    ran(*parts[:1])
    out.write_text(out.read_text() + '{"part": "pl')  # cut off by a kill
    printed = ran(*parts)
    found = [json.loads(line) for line in printed if line.startswith("{")]
    assert [line["part"] for line in found] == parts[1:]
    assert not any("error" in line for line in found)
    assert sum(line.startswith("| ") for line in printed) == 2 + len(parts)
