"""Measure the speed of rollouts in this package or in stock LIBERO.

    PYTHONPATH=src:. python scripts/libero_speed.py
    PYTHONPATH=src:. LIBERO/bin/python scripts/libero_speed.py stock    # in the environment of `libero_records`
    PYTHONPATH=src:. python scripts/libero_speed.py suite LIBERO/bin/python    # of `libero_suite_records`, with LeRobot

Prints CPU milliseconds of construction, reset, step and rollout; both cameras are rendered at each reset and step. Do
not run both at the same time. `suite` measures a task of `libero_spatial` here and in LeRobot's environment of stock
LIBERO in turns, and extrapolates the suite with a policy without cost that never succeeds.
"""

from __future__ import annotations

import statistics
import subprocess
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


# --- a suite ---

SUITE, TASK_ID = "libero_spatial", 0
TASK_COUNT, EPISODES, LIMIT = 10, 50, 280
BLOCKS = {"reset": 1, "step with two pictures": 10, "step without": 30}
"""Operation -> its repetitions in a turn."""
TURNS = 3


def serve() -> None:
    """Run an operation of stock LIBERO for each line of stdin, and print its CPU seconds."""
    from lerobot.envs.libero import LiberoEnv
    from libero.libero import benchmark

    def construct() -> Any:
        env = LiberoEnv(benchmark.get_benchmark_dict()[SUITE](), TASK_ID, SUITE, obs_type="pixels_agent_pos")
        env.reset(seed=7)
        return env

    construction, env = cpu_seconds(construct)
    print("seconds", construction, flush=True)
    for line in sys.stdin:
        name = line.strip()
        simulator = env._env.env
        for camera in ("agentview", "robot0_eye_in_hand"):
            simulator.modify_observable(f"{camera}_image", "enabled", name != "step without")
        operations: dict[str, Callable[[], Any]] = {
            "reset": lambda: env.reset(seed=7),
            "step with two pictures": lambda: env.step(np.array(ACTION)),
            "step without": lambda: (env._env.step(ACTION), env._env.check_success()),
        }
        print("seconds", repeated(operations[name], BLOCKS[name]), flush=True)


def repeated(operation: Callable[[], Any], count: int) -> float:
    """Return the CPU seconds of one of some repetitions."""
    return cpu_seconds(lambda: [operation() for _ in range(count)])[0] / count


def suite(python: str) -> None:
    """Print the speed of an episode of a suite here and in stock LIBERO, and the hours of the suite."""
    from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
    from lerobot_memobench.tasks.libero_suites import get_libero_task, initial_states, libero_tasks

    task = get_libero_task(libero_tasks(SUITE)[TASK_ID])
    worker = subprocess.Popen([python, "-W", "ignore", __file__, "serve"], stdin=-1, stdout=-1, text=True)
    assert worker.stdin is not None
    assert worker.stdout is not None

    def stock_seconds() -> float:
        for line in worker.stdout or ():
            if line.startswith("seconds "):
                return float(line.split()[1])
        raise SystemExit("stock LIBERO ended; see its message above")

    def start() -> Any:
        sim = Simulation(task)
        reset(sim)
        return sim

    def reset(sim: Simulation) -> None:
        sim.reset(7, state=initial_states(task.name)[0])
        render(sim)

    def render(sim: Simulation) -> None:
        for camera in MJCF_CAMERAS:
            sim.render(camera)

    def step(sim: Simulation) -> None:
        sim.step(ACTION)
        render(sim)

    ours: dict[str, list[float]] = {name: [] for name in BLOCKS}
    stock: dict[str, list[float]] = {name: [] for name in BLOCKS}
    construction, sim = cpu_seconds(start)
    constructions = construction, stock_seconds()
    operations: dict[str, Callable[[], Any]] = {
        "reset": lambda: reset(sim),
        "step with two pictures": lambda: step(sim),
        "step without": lambda: sim.step(ACTION),
    }
    for _ in range(TURNS):
        for name, operation in operations.items():
            ours[name].append(repeated(operation, BLOCKS[name]))
            print(name, file=worker.stdin, flush=True)
            stock[name].append(stock_seconds())
    worker.stdin.close()
    worker.wait()
    print("operation | here, ms | stock LIBERO, ms | ratio")
    rows = {"construction and first reset": constructions}
    rows |= {name: (statistics.median(ours[name]), statistics.median(stock[name])) for name in BLOCKS}
    for name, (here, there) in rows.items():
        print(f"{name} | {1e3 * here:,.1f} | {1e3 * there:,.1f} | {there / here:.1f}")
    here, there = (
        TASK_COUNT * (rows["construction and first reset"][side] - rows["reset"][side])
        + TASK_COUNT * EPISODES * (rows["reset"][side] + LIMIT * rows["step with two pictures"][side])
        for side in (0, 1)
    )
    episodes = f"{SUITE}, {TASK_COUNT} x {EPISODES} episodes of {LIMIT} steps"
    print(f"{episodes} | {here / 3600:.2f} h | {there / 3600:.2f} h | {there / here:.1f}")


if __name__ == "__main__" and sys.argv[1:] == ["serve"]:
    serve()
elif __name__ == "__main__" and sys.argv[1:2] == ["suite"]:
    suite(sys.argv[2])
elif __name__ == "__main__":
    print("task | seed | construction and first reset | reset | step | rollout")
    for task_name in TASKS:
        measure(stock_operations if sys.argv[1:] == ["stock"] else our_operations, task_name)
