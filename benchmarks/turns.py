"""Compare alternatives fairly on a machine that may be busy: run them in turns, and report medians."""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import truediv
from pathlib import Path
from typing import Any

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

    def __init__(self, script: str, source: Path, *arguments: str, python: str = sys.executable) -> None:
        self.process = subprocess.Popen(
            [python, "-W", "ignore", script, "--serve", *arguments],
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


# --- tables of several sides ---

Rows = dict[str | None, dict[str, list[list[float]]]]
"""Row of a table -> side -> answers of `answer_calls`."""


def answer_calls(methods: object) -> None:
    """Answer requests ``[method, repetitions, *arguments]``: CPU and elapsed seconds of a call, or what it returns."""

    def measure(request: str) -> list[float]:
        name, repetitions, *arguments = json.loads(request)
        result, cpu, elapsed = None, time.process_time(), time.perf_counter()
        for _ in range(repetitions):
            result = getattr(methods, name)(*arguments)
        seconds = time.process_time() - cpu, time.perf_counter() - elapsed
        return result or [value / max(repetitions, 1) for value in seconds]

    answer_requests(measure)


@contextlib.contextmanager
def all_sides(starts: Mapping[str, Callable[[], Worker]], turn: int, rows: Rows) -> Iterator[Callable[..., None]]:
    """Start a process of `answer_calls` for each side; yield a function that calls a method on all, one after another.

    It adds the answers to a row, or to none (None). The order of the sides alternates from turn to turn.
    """
    workers = {name: starts[name]() for name in ([*starts][::-1] if turn % 2 else starts)}

    def call(row: str | None, method: str, *arguments: Any, repetitions: int = 1) -> None:
        for name, worker in workers.items():
            answer = worker.ask(json.dumps([method, repetitions, *arguments]))
            rows.setdefault(row, {}).setdefault(name, []).append(answer)

    call(None, "", repetitions=0)  # returns when all have imported their libraries
    yield call
    for worker in workers.values():
        worker.close()


def print_table(title: str, rows: Rows, average: Callable[[list[float]], float], scale: float = 1.0) -> None:
    """Print the averages of each row's pairs of values as Markdown, and their ratios to those of the first side."""
    first, *others = next(iter(rows.values()))
    print(f"| {title} | {first} |" + "".join(f" {name} | ratio |" for name in others))
    print("|---|---:|" + "---:|---:|" * len(others))
    for row, answers in rows.items():
        if row is None:
            continue
        means = {
            name: [scale * average([*values]) for values in zip(*pairs, strict=True)] for name, pairs in answers.items()
        }
        cells = [pair(means[first])]
        for name in others:
            cells += [pair(means[name]), pair(map(truediv, means[name], means[first]))] if name in means else ["–", "–"]
        print(f"| {row} | {' | '.join(cells)} |")
    print(flush=True)


def pair(values: Iterable[float]) -> str:
    """Return two values as a cell of a table, with three digits or more."""
    return " / ".join(f"{value:,.{0 if value >= 100 else 1 if value >= 10 else 2}f}" for value in values)
