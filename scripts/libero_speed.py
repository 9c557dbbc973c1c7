"""Measure the speed of rollouts in this package or in stock LIBERO.

    PYTHONPATH=src:. python scripts/libero_speed.py
    PYTHONPATH=src:. LIBERO/bin/python scripts/libero_speed.py stock    # in the environment of `libero_records`

Prints CPU milliseconds of construction, reset, step and rollout; both cameras are rendered at each reset and step. Do
not run both at the same time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

TASKS = (
    "check_all_three_drawers_of_the_cabinet",
    "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_the_shelf",
    "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate",
)
SEEDS = (7, 8)
STEPS, ROLLOUT_STEPS = 50, 400
"""Measured control steps, and steps of a rollout: the expert's mean over all tasks."""
ACTION = [0.1, 0.1, 0.0, 0.0, 0.0, 0.0, -1.0]

Operations = tuple[Callable[[int], Any], Callable[[], Any]]
"""Reset to a seed, and one control step, both with images."""


def our_operations(name: str) -> Operations:
    """Return the operations of this package's simulation of a task."""
    from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
    from lerobot_memobench.tasks.catalogue import get_task

    sim = Simulation(get_task(name))

    def reset(seed: int) -> None:
        sim.reset(seed)
        render()

    def step() -> None:
        sim.step(np.array(ACTION))
        render()

    def render() -> None:
        for camera in MJCF_CAMERAS:
            sim.render(camera)

    return reset, step


def stock_operations(name: str) -> Operations:
    """Return the operations of stock LIBERO; the reset includes the stabilisation steps, as ours does."""
    from scripts.libero_records import NO_OP, STABILISATION_STEPS, make

    env = make(name, images=True)

    def reset(seed: int) -> None:
        env.seed(seed)
        env.reset()
        for _ in range(STABILISATION_STEPS):
            env.step(NO_OP)

    return reset, lambda: env.step(ACTION)


def measure(operations: Callable[[str], Operations], name: str) -> None:
    """Print a row for each seed of a task."""
    construction, (reset, step) = cpu_seconds(operations, name)
    first_reset, _ = cpu_seconds(reset, SEEDS[0])
    for seed in SEEDS:
        begin, _ = cpu_seconds(reset, seed)
        each = cpu_seconds(lambda: [step() for _ in range(STEPS)])[0] / STEPS
        values = construction + first_reset, begin, each, begin + ROLLOUT_STEPS * each
        print(name, seed, *(f"{1e3 * value:,.1f}" for value in values), sep=" | ", flush=True)


def cpu_seconds(function: Callable[..., Any], *args: Any) -> tuple[float, Any]:
    """Return the CPU seconds and the result of a call."""
    start = time.process_time()
    result = function(*args)
    return time.process_time() - start, result


if __name__ == "__main__":
    print("task | seed | construction and first reset | reset | step | rollout")
    for task_name in TASKS:
        measure(stock_operations if sys.argv[1:] == ["stock"] else our_operations, task_name)
