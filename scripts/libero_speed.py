"""Measure how fast rollouts of the paper's world are, here or in stock LIBERO.

    PYTHONPATH=src:. python scripts/libero_speed.py
    PYTHONPATH=src:. LIBERO/bin/python scripts/libero_speed.py stock    # in the environment of `libero_records`

prints CPU milliseconds of each part and of a rollout, both cameras drawn at each reset and step. Run one after the
other: what else runs on a machine slows both.
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
STEPS, ROLLOUT = 50, 400
"""Control steps that are measured, and of a rollout: the expert takes 400 of the thirty tasks' mean."""
ACTION = [0.1, 0.1, 0.0, 0.0, 0.0, 0.0, -1.0]

Parts = tuple[Callable[[int], Any], Callable[[], Any]]
"""Reset to a seed, and one control step, both with pictures."""


def ours(name: str) -> Parts:
    """Return the parts of this package's simulation of a task."""
    from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
    from lerobot_memobench.tasks.catalogue import get_task

    sim = Simulation(get_task(name).in_world("libero"))

    def reset(seed: int) -> None:
        sim.reset(seed)
        look()

    def step() -> None:
        sim.step(np.array(ACTION))
        look()

    def look() -> None:
        for camera in MJCF_CAMERAS:
            sim.render(camera)

    return reset, step


def stock(name: str) -> Parts:
    """Return the parts of stock LIBERO's environment of a task, which settles as ours does within its reset."""
    from scripts.libero_records import NO_OP, STABILISATION_STEPS, make

    env = make(name, pictures=True)

    def reset(seed: int) -> None:
        env.seed(seed)
        env.reset()
        for _ in range(STABILISATION_STEPS):
            env.step(NO_OP)

    return reset, lambda: env.step(ACTION)


def measure(parts: Callable[[str], Parts], name: str) -> None:
    """Print a line for each seed of a task."""

    def steps() -> None:
        for _ in range(STEPS):
            step()

    made, (reset, step) = clock(parts, name)
    first, _ = clock(reset, SEEDS[0])
    for seed in SEEDS:
        begun, _ = clock(reset, seed)
        each = clock(steps)[0] / STEPS
        values = made + first, begun, each, begun + ROLLOUT * each
        print(name, seed, *(f"{1e3 * value:,.1f}" for value in values), sep=" | ", flush=True)


def clock(work: Callable[..., Any], *given: Any) -> tuple[float, Any]:
    """Return the CPU time of a call, s, and its result."""
    start = time.process_time()
    found = work(*given)
    return time.process_time() - start, found


if __name__ == "__main__":
    print("task | seed | construction and first reset | reset | step | rollout")
    for one in TASKS:
        measure(stock if sys.argv[1:] == ["stock"] else ours, one)
