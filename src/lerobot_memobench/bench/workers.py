"""Several processes at once: steps per second together, and the memory of each."""

from __future__ import annotations

import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.bench.line import Line
from lerobot_memobench.bench.machine import TASK, machine
from lerobot_memobench.bench.sides import Ours, actions, close_stock, stock_robosuite
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.threads import by_the_libraries, by_the_rule

WORKERS = (1, 2, 4)


def _resident_mb() -> float:
    """Return the memory of this process that no other shares, plus its part of what is shared, MB."""
    try:
        text = Path("/proc/self/smaps_rollup").read_text()
        pss = next(line for line in text.splitlines() if line.startswith("Pss:"))
        return int(pss.split()[1]) / 1024
    except (OSError, StopIteration):
        return float("nan")


def _worker(stock: bool, task: str, seconds: float, ready: Any, go: Any, results: Any) -> None:
    """Step with both images for some seconds and report the number of steps and the memory."""
    moves = actions()
    if stock:
        env = stock_robosuite()
        env.reset()
        step: Callable[[NDArray[np.float64]], Any] = env.step
    else:
        step = Ours(task).step
    step(next(moves))
    ready.release()
    go.wait()
    count, end = 0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        step(next(moves))
        count += 1
    results.put((count / seconds, _resident_mb()))
    if stock:
        close_stock(env)


def _team(stock: bool, count: int, task: str, seconds: float) -> tuple[float, float]:
    """Return steps per second of all workers together, and the mean memory of one, MB."""
    context = multiprocessing.get_context("spawn")
    ready, go, results = context.Semaphore(0), context.Event(), context.Queue()
    team = [
        context.Process(target=_worker, args=(stock, task, seconds, ready, go, results), daemon=True)
        for _ in range(count)
    ]
    with patch.dict(os.environ, by_the_libraries() if stock else by_the_rule(), clear=True):
        for process in team:
            process.start()
    try:
        for _ in team:
            if not ready.acquire(timeout=300):
                raise MemobenchError(f"one of {count} worker processes did not get ready within five minutes")
        go.set()
        reports = [results.get(timeout=seconds + 60) for _ in team]
    finally:
        for process in team:
            process.join(timeout=10)
            if process.is_alive():
                process.terminate()
    return sum(rate for rate, _ in reports), statistics.fmean(memory for _, memory in reports)


def workers(task: str = TASK, counts: tuple[int, ...] = WORKERS, seconds: float = 5.0) -> list[Line]:
    """Steps with images per second of several processes together, and the memory of each."""
    lines = []
    for count in counts:
        ours, memory = _team(False, count, task, seconds)
        theirs, their_memory = _team(True, count, task, seconds)
        detail = {
            "task": task,
            "workers": count,
            "memory_mb": round(memory),
            "their_memory_mb": round(their_memory),
        }
        ratio = round(ours / theirs, 2)
        lines.append(Line(f"workers_{count}", round(ours, 1), round(theirs, 1), ratio, "steps/s", machine(), detail))
    return lines
