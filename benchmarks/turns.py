"""Compare alternatives fairly on a machine that may be busy: run them in turns, and report medians."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

PREFIX = "result "
"""Start of a worker's answer; libraries print other lines to stdout."""


def medians(alternatives: Mapping[str, Callable[[], object]], repeats: int, warm_up: int = 1) -> dict[str, float]:
    """Return the median CPU seconds of each alternative.

    The order alternates from turn to turn, so that other load affects all alternatives. CPU seconds count all threads
    of this process; on a busy machine, elapsed time would mostly measure the other processes.
    """
    seconds: dict[str, list[float]] = {name: [] for name in alternatives}
    names = list(alternatives)
    for turn in range(repeats + warm_up):
        for name in names if turn % 2 else reversed(names):
            started = time.process_time()
            alternatives[name]()
            if turn >= warm_up:
                seconds[name].append(time.process_time() - started)
    return {name: statistics.median(values) for name, values in seconds.items()}


class Worker:
    """A process that runs ``script --serve ARGUMENTS`` with the package of a given source folder."""

    def __init__(self, script: str, source: Path, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", script, "--serve", *arguments],
            env={**os.environ, "PYTHONPATH": f"{source}{os.pathsep}{source.parent}"},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def ask(self, request: str = "") -> list[float]:
        """Send a request and return the measured values."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(request, file=self.process.stdin, flush=True)
        for line in self.process.stdout:
            if line.startswith(PREFIX):
                return list(json.loads(line.removeprefix(PREFIX)))
        raise SystemExit("a worker process failed; its error is printed above")

    def close(self) -> None:
        """Wait for the end of the process."""
        self.process.communicate()


def answer_requests(measure: Callable[[str], list[float]]) -> None:
    """Answer each request on stdin with measured values: the loop of a worker process."""
    for line in sys.stdin:
        print(PREFIX + json.dumps(measure(line.strip())), flush=True)
