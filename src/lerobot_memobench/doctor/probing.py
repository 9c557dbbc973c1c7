"""Run a probe in a process of its own: a broken driver ends it with a signal, which only its parent can report."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from typing import Any

PROBE = "lerobot_memobench.doctor.probe"


def run_probe(*words: str, timeout_s: float = 180.0) -> dict[str, Any]:
    """Run a probe in a process of its own; return its answer, or {"error": …} however it ended."""
    command = [sys.executable, "-m", PROBE, *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"no answer in {timeout_s:.0f} s"}
    if done.returncode < 0:
        return {"error": f"the process was killed by {signal.Signals(-done.returncode).name}"}
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        reason = (done.stderr.strip().splitlines() or ["without a message"])[-1]
        return {"error": f"the process ended with status {done.returncode}: {reason}"}
    answer = json.loads(lines[-1])
    assert isinstance(answer, dict)
    return answer
