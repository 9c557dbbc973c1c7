"""Another state of the source, this one and stock robosuite 1.4.1, in turns in one run: a Markdown table.

    python benchmarks/before_after.py FOLDER [ROUNDS]

FOLDER holds the other state's `lerobot_memobench` (`git worktree add /tmp/before COMMIT`, then `/tmp/before/src`). Each
side is a process of its own that waits until it is asked; every figure is a median over the rounds, the ratios too.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).parents[1] / "src"
ROWS = {
    "step with both images": ("images", "step", 10),
    "reset with both images": ("images", "reset", 3),
    "step without images": ("bare", "step", 30),
}
"""What is measured: which environments, what they do, and how often ours do it in a round."""


def ours(images: bool, logs: str) -> dict[str, Callable[[Any], Any]]:
    """Return how the project steps and resets: LeRobot's vector environment, or the simulation without images."""
    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
    from research.speed.sides import TASK, Ours

    if not images:
        side = Ours(TASK, images=False)
        return {"step": side.step, "reset": side.reset}
    config = MemobenchEnvConfig(tasks=TASK, demonstration_prompt=False, log_dir=logs)
    [suite] = config.create_envs(1).values()
    [env] = suite.values()
    env.reset(seed=[0])
    return {"step": lambda action: env.step(action[None].astype("float32")), "reset": lambda k: env.reset(seed=[k])}


def stock(images: bool, _: str) -> dict[str, Callable[[Any], Any]]:
    """Return how stock robosuite steps and resets."""
    from research.speed.sides import stock_robosuite

    env = stock_robosuite(images)
    env.reset()
    return {"step": env.step, "reset": lambda _: env.reset()}


def serve(side: str, kind: str) -> None:
    """Answer each line ``what times`` with the median seconds on the wall and of processors."""
    from research.speed.sides import actions

    with tempfile.TemporaryDirectory() as logs:
        does, moves, seed = (stock if side == "stock" else ours)(kind == "images", logs), actions(), 0
        for line in sys.stdin:
            what, times = line.split()
            taken = []
            for _ in range(int(times)):
                seed += 1
                argument = next(moves) if what == "step" else seed
                wall, cpu = time.perf_counter(), time.process_time()
                does[what](argument)
                taken.append((time.perf_counter() - wall, time.process_time() - cpu))
            print("medians", json.dumps([statistics.median(clock) for clock in zip(*taken, strict=True)]), flush=True)
    os._exit(0)  # robosuite cannot close its context in order


class Side:
    """A process that serves."""

    def __init__(self, name: str, source: Path, kind: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", __file__, "--serve", name, kind],
            env={**os.environ, "PYTHONPATH": f"{source}{os.pathsep}{source.parent}"},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def ask(self, what: str, times: int) -> list[float]:
        """Return the medians, s: wall, processors."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(what, times, file=self.process.stdin, flush=True)
        for line in self.process.stdout:
            if line.startswith("medians "):
                return list(json.loads(line.removeprefix("medians ")))
        raise SystemExit("a side ended early; its words are above")


def row(name: str, rounds: list[list[list[float]]], clock: int) -> str:
    """Return the table's row of one clock, of rounds of (before, after, stock)."""
    before, after, other = zip(*([side[clock] for side in taken] for taken in rounds), strict=True)
    figures = [f"{1e3 * statistics.median(side):.2f} ms" for side in (before, after, other)]
    figures += [
        f"{statistics.median(b / a for a, b in zip(side, other, strict=True)):.1f}×" for side in (before, after)
    ]
    return f"| {name}, {('wall', 'CPU')[clock]} | {' | '.join(figures)} |"


def main(before: Path, rounds: int) -> None:
    """Measure and print."""
    sources = {"before": before, "after": HERE, "stock": HERE}
    print("| | before | after | stock | ratio before | ratio after |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, (kind, what, times) in ROWS.items():
        sides = {side: Side(side, source, kind) for side, source in sources.items()}
        counts = {"before": times, "after": times, "stock": max(1, times // 4)}
        for side in sides.values():
            side.ask(what, 2)  # the first ones compile shaders
        taken = [[sides[side].ask(what, count) for side, count in counts.items()] for _ in range(rounds)]
        for side in sides.values():
            side.process.communicate()
        print(row(name, taken, 0), row(name, taken, 1), sep="\n", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--serve":
        serve(*sys.argv[2:])
    else:
        main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 8)
