"""Claims about the simulator's speed, measured against stock robosuite 1.4.1 in one run.

Both sides take turns, and each turn of ours makes a pair with the turn of theirs that follows. Claims are the
median of the pairs' ratios of wall time on an idle machine; CPU time is reported too, and varies less on a shared
machine. Stock robosuite is its own PickPlace with the same arm, controller,
cameras and sizes, in a process of its own: there its libraries take the threads that they take by themselves, while
ours has those of the rule (`jobs.threads`), as in every command.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, nearest
from research.speed.sides import (
    TASK,
    Apart,
    Line,
    Ours,
    Times,
    Vectored,
    actions,
    alternate,
    close_stock,
    line_of,
    machine,
    reset_stock,
    step_stock,
    stock_open,
    stock_robosuite,
    timed,
)
from research.speed.threads import by_the_libraries, by_the_rule

# --- several processes at once: steps per second together, and the memory of each ---

WORKERS = (1, 2, 4)


def _resident_mb() -> float:
    """Return the memory of this process, with its part of shared memory, MB."""
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


# --- steps and resets ---


def step_with_images(task: str = TASK, quality: str = "default", rounds: int = 8) -> Line:
    """One control step with both 256×256 images."""
    return _step("step_with_images", task, quality, rounds, images=True)


def step_without_images(task: str = TASK, rounds: int = 12) -> Line:
    """One control step, physics and controller alone."""
    return _step("step_without_images", task, "default", rounds, images=False)


def _step(name: str, task: str, quality: str, rounds: int, images: bool) -> Line:
    ours = Ours(task, images, quality)
    with stock_open(images) as stock:
        pairs = _step_pairs(ours, stock, rounds)
    detail = {"task": task, "quality": quality} if images else {"task": task}
    return line_of(name, pairs, detail)


def _step_pairs(ours: Ours | Vectored, stock: Apart, rounds: int) -> list[tuple[Times, Times]]:
    moves = actions()

    def their_turn() -> Times:
        taken: Times = stock.does(step_stock, next(moves))
        return taken

    def our_turn() -> Times:
        return timed(lambda: ours.step(next(moves)))

    for _ in range(3):  # the first frames compile shaders
        our_turn(), their_turn()
    return alternate(our_turn, their_turn, rounds, 20, 5)


def reset(task: str = TASK, rounds: int = 3) -> Line:
    """Reset to a new seed with both images; ours includes the ten stabilisation steps."""
    ours = Ours(task)
    with stock_open(True) as stock:
        pairs = _reset_pairs(ours, stock, rounds)
    return line_of("reset", pairs, {"task": task})


def _reset_pairs(ours: Ours | Vectored, stock: Apart, rounds: int) -> list[tuple[Times, Times]]:
    seeds = iter(range(1, 10**9))

    def their_turn() -> Times:
        taken: Times = stock.does(reset_stock)
        return taken

    return alternate(lambda: timed(lambda: ours.reset(next(seeds))), their_turn, rounds, 8, 1)


def vector_env(task: str = TASK, rounds: int = 8) -> list[Line]:
    """Steps and resets through the vector environment that LeRobot uses, both images, against bare stock robosuite."""
    ours = Vectored(task)
    with stock_open(True) as stock:
        steps, resets = _step_pairs(ours, stock, rounds), _reset_pairs(ours, stock, max(1, rounds // 2))
        ours.close()
    return [line_of("vector_env_step", steps, {"task": task}), line_of("vector_env_reset", resets, {"task": task})]


# --- all benchmarks ---


def thread_rule() -> list[Line]:
    """`lerobot eval` with the threads of the rule, and with the libraries' own."""
    from research.speed import evaluation

    return evaluation.thread_rule()


def eval_loop() -> list[Line]:
    """A control step of ``lerobot eval``; LeRobot is imported for it, which takes longer than the other claims."""
    from research.speed import evaluation

    return evaluation.eval_loop()


BENCHMARKS: dict[str, Callable[[], Line | list[Line]]] = {
    "step_with_images": step_with_images,
    "step_without_images": step_without_images,
    "reset": reset,
    "vector_env": vector_env,
    "workers": workers,
    "eval_loop": eval_loop,
    "thread_rule": thread_rule,
}


def measure(names: list[str] | None = None) -> Iterator[Line]:
    """Yield the lines of the named benchmarks, all of them by default, as they are measured."""
    for name in names or list(BENCHMARKS):
        if name not in BENCHMARKS:
            raise MemobenchError(f"there is no benchmark {name!r}; {nearest(name, BENCHMARKS)}")
        result = BENCHMARKS[name]()
        yield from result if isinstance(result, list) else [result]
