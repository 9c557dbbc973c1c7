"""Measure the speed of an episode of a LIBERO suite here and in stock LIBERO, in turns.

    PYTHONPATH=src:. python scripts/libero_speed.py outputs/libero/stock/bin/python

`scripts/stock_libero` builds that environment. Stock LIBERO is LeRobot's `LiberoEnv`. Prints CPU milliseconds of one
process each, medians of the turns, and extrapolates the suite with a policy without cost that never succeeds. Without
an argument this package alone is measured.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

SUITE, TASK_ID = "libero_spatial", 0
TASK_COUNT, EPISODES, LIMIT = 10, 50, 280
FIRST, RESET, STEP, STEP_WITHOUT = "construction and first reset", "reset", "step with two images", "step without"
BLOCKS = {RESET: 1, STEP: 10, STEP_WITHOUT: 30}
"""Operation -> its repetitions in a turn."""
TURNS = 3
ACTION = [0.1, 0.1, 0.0, 0.0, 0.0, 0.0, -1.0]

Operations = dict[str, Callable[[], Any]]


def cpu_seconds(operation: Callable[[], Any], count: int = 1) -> float:
    """Return the CPU seconds of one of some repetitions."""
    start = time.process_time()
    for _ in range(count):
        operation()
    return (time.process_time() - start) / count


def here() -> Operations:
    """Return the operations of this package; the first constructs the simulation."""
    from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
    from lerobot_memobench.tasks.catalogue import get_task, initial_states, task_names

    task = get_task(task_names(suite=SUITE)[TASK_ID])
    sims: list[Simulation] = []

    def first() -> None:
        sims.append(Simulation(task))
        reset()

    def reset() -> None:
        sims[0].reset(7, state=initial_states(task.name)[0])
        render()

    def step() -> None:
        sims[0].step(np.array(ACTION))
        render()

    def render() -> None:
        for camera in MJCF_CAMERAS:
            sims[0].render(camera)

    return {FIRST: first, RESET: reset, STEP: step, STEP_WITHOUT: lambda: sims[0].step(np.array(ACTION))}


def stock() -> Operations:
    """Return the operations of LeRobot's environment of stock LIBERO; the first constructs it."""
    from lerobot.envs.libero import LiberoEnv
    from libero.libero import benchmark

    envs: list[Any] = []

    def first() -> None:
        envs.append(LiberoEnv(benchmark.get_benchmark_dict()[SUITE](), TASK_ID, SUITE, obs_type="pixels_agent_pos"))
        envs[0].reset(seed=7)

    def draw(images: bool) -> None:
        for camera in ("agentview", "robot0_eye_in_hand"):
            envs[0]._env.env.modify_observable(f"{camera}_image", "enabled", images)

    def step() -> None:
        draw(True)
        envs[0].step(np.array(ACTION))

    def step_without() -> None:
        draw(False)
        envs[0]._env.step(ACTION)
        envs[0]._env.check_success()

    def reset() -> None:
        draw(True)
        envs[0].reset(seed=7)

    return {FIRST: first, RESET: reset, STEP: step, STEP_WITHOUT: step_without}


def serve() -> None:
    """Run an operation of stock LIBERO for each line of stdin, and print its CPU seconds."""
    operations = stock()
    for line in sys.stdin:
        name = line.strip()
        print("seconds", cpu_seconds(operations[name], BLOCKS.get(name, 1)), flush=True)


def seconds_in(python: str) -> Iterator[float]:
    """Yield the seconds of each operation, in the order of `turns`, in a process with another Python."""
    with subprocess.Popen([python, "-W", "ignore", __file__, "serve"], stdin=-1, stdout=-1, text=True) as worker:
        assert worker.stdin is not None
        assert worker.stdout is not None
        for name in turns():
            print(name, file=worker.stdin, flush=True)
            for line in worker.stdout:
                if line.startswith("seconds "):  # LIBERO prints lines of its own
                    yield float(line.split()[1])
                    break
            else:
                raise SystemExit("stock LIBERO ended; see its message above")


def turns() -> list[str]:
    """Return the operations in the order of their measurement."""
    return [FIRST, *[name for _ in range(TURNS) for name in BLOCKS]]


def main(python: str | None = None) -> None:
    """Measure both sides in turns, and print a row for each operation and one for the suite."""
    operations = here()
    sides: list[dict[str, list[float]]] = [{} for _ in range(2 if python else 1)]
    theirs = seconds_in(python) if python else None
    for name in turns():
        sides[0].setdefault(name, []).append(cpu_seconds(operations[name], BLOCKS.get(name, 1)))
        if theirs:
            sides[1].setdefault(name, []).append(next(theirs))
    print("operation | here, ms", *(["stock LIBERO, ms", "ratio"] if python else []), sep=" | ")
    medians = [{name: statistics.median(values) for name, values in side.items()} for side in sides]
    for name in (FIRST, *BLOCKS):
        print_row(name, [1e3 * side[name] for side in medians], ".1f")
    seconds = [
        TASK_COUNT * (side[FIRST] - side[RESET]) + TASK_COUNT * EPISODES * (side[RESET] + LIMIT * side[STEP])
        for side in medians
    ]
    episodes = f"{SUITE}, {TASK_COUNT} x {EPISODES} episodes of {LIMIT} steps, h"
    print_row(episodes, [second / 3600 for second in seconds], ".2f")


def print_row(name: str, values: list[float], form: str) -> None:
    """Print the values of both sides and their ratio."""
    cells = [f"{value:,{form}}" for value in values]
    print(name, *cells, *([f"{values[1] / values[0]:.1f}"] if len(values) == 2 else []), sep=" | ")


if __name__ == "__main__":
    serve() if sys.argv[1:] == ["serve"] else main(*sys.argv[1:])
