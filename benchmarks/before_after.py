"""Compare the speed of the simulator at another commit, at this commit and of stock robosuite 1.4.1, in turns.

    python benchmarks/before_after.py FOLDER [ROUNDS]

FOLDER holds `lerobot_memobench` of the other commit (`git worktree add /tmp/before COMMIT`, then `/tmp/before/src`).
Each of the three runs in a process of its own. Prints a Markdown table; all values, ratios included, are medians over
the rounds.
"""

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from turns import Worker, answer_requests

HERE = Path(__file__).parents[1] / "src"
ROWS = {
    "step with both images": ("images", "step", 10),
    "reset with both images": ("images", "reset", 3),
    "step without images": ("no images", "step", 30),
}
"""Row -> kind of environment, operation, repetitions per round."""
Operations = dict[str, Callable[[Any], Any]]


def our_operations(images: bool, log_dir: str) -> Operations:
    """Return step and reset of LeRobot's vector environment, or of the simulation alone without images."""
    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
    from research.speed.sides import TASK, Ours

    if not images:
        simulation = Ours(TASK, images=False)
        return {"step": simulation.step, "reset": simulation.reset}
    config = MemobenchEnvConfig(tasks=TASK, demonstration_prompt=False, log_dir=log_dir)
    [suite] = config.create_envs(1).values()
    [env] = suite.values()
    env.reset(seed=[0])
    return {"step": lambda action: env.step(action[None].astype("float32")), "reset": lambda k: env.reset(seed=[k])}


def stock_operations(images: bool, _: str) -> Operations:
    """Return step and reset of stock robosuite."""
    from research.speed.sides import stock_robosuite

    env = stock_robosuite(images)
    env.reset()
    return {"step": env.step, "reset": lambda _: env.reset()}


def serve(name: str, kind: str) -> None:
    """Answer requests ``operation repetitions`` with median wall seconds and median CPU seconds."""
    from research.speed.sides import actions

    with tempfile.TemporaryDirectory() as log_dir:
        make = stock_operations if name == "stock" else our_operations
        operations, action_stream = make(kind == "images", log_dir), actions()
        seed = 0

        def measure(request: str) -> list[float]:
            nonlocal seed
            operation, repetitions = request.split()
            times = []
            for _ in range(int(repetitions)):
                seed += 1
                argument = next(action_stream) if operation == "step" else seed
                wall, cpu = time.perf_counter(), time.process_time()
                operations[operation](argument)
                times.append((time.perf_counter() - wall, time.process_time() - cpu))
            return [statistics.median(clock) for clock in zip(*times, strict=True)]

        answer_requests(measure)
    os._exit(0)  # robosuite fails when it closes its rendering context at exit


def table_row(name: str, rounds: list[list[list[float]]], clock: int) -> str:
    """Return a row for wall (0) or CPU (1) time; ``rounds`` holds the values of before, after and stock."""
    before, after, stock = zip(*([side[clock] for side in values] for values in rounds), strict=True)
    cells = [f"{1e3 * statistics.median(side):.2f} ms" for side in (before, after, stock)]
    cells += [f"{statistics.median(b / a for a, b in zip(side, stock, strict=True)):.1f}×" for side in (before, after)]
    return f"| {name}, {('wall', 'CPU')[clock]} | {' | '.join(cells)} |"


def main(before: Path, rounds: int) -> None:
    """Measure and print."""
    sources = {"before": before, "after": HERE, "stock": HERE}
    print("| | before | after | stock | ratio before | ratio after |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, (kind, operation, count) in ROWS.items():
        workers = {side: Worker(__file__, source, side, kind) for side, source in sources.items()}
        counts = {"before": count, "after": count, "stock": max(1, count // 4)}
        for worker in workers.values():
            worker.ask(f"{operation} 2")  # the first calls compile shaders
        values = [[workers[side].ask(f"{operation} {count}") for side, count in counts.items()] for _ in range(rounds)]
        for worker in workers.values():
            worker.close()
        print(table_row(name, values, 0), table_row(name, values, 1), sep="\n", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--serve":
        serve(*sys.argv[2:])
    else:
        main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 8)
