"""``python -m research.speed.checkouts FOLDER``: compare control steps with two pictures of two checkouts.

Each checkout steps the same actions in a process of its own, in turns; a turn of ours makes a pair with the turn of
theirs that follows. Processors' time is counted, which moves less than the clock on the wall where others compute too.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.errors import MemobenchError
from research.command import run
from research.speed.sides import TASK

PARTS = ("step", "agentview", "wrist", "all")
_SOURCE = Path("src/lerobot_memobench/__init__.py")
_SIDE = """
import json, statistics, sys, time
import numpy as np
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.progress import Progress

task, rng = get_task(sys.argv[1]), np.random.default_rng(0)
sim, progress = Simulation(task, RenderSettings(quality=sys.argv[2])), Progress(task)
sim.reset(0)
for line in sys.stdin:
    taken = []
    for _ in range(int(line)):
        action = rng.uniform(-0.3, 0.3, 7)
        clock = [time.process_time()]
        sim.step(action)
        progress.step(sim.holds)
        clock.append(time.process_time())
        for camera in ("agentview", "wrist"):
            sim.render(camera)
            clock.append(time.process_time())
        taken.append([b - a for a, b in zip(clock, clock[1:])] + [clock[-1] - clock[0]])
    print(json.dumps([1e3 * statistics.median(part) for part in zip(*taken)]), flush=True)
"""
"""It speaks to both checkouts, so it uses what both have."""


class Side:
    """A checkout in a process of its own.

    Args:
        folder: the checkout.
        task, quality: of the simulation and its pictures.
    """

    def __init__(self, folder: Path, task: str, quality: str) -> None:
        if not (folder / _SOURCE).is_file():
            raise MemobenchError(f"{folder} is no checkout of this project: it has no {_SOURCE}")
        environment = {**os.environ, "PYTHONPATH": str(folder / "src"), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SIDE, task, quality],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def take(self, steps: int) -> list[float]:
        """Take control steps; return the median of each of `PARTS`, ms."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{steps}\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise MemobenchError("a side has ended; see its message above")
        return [float(part) for part in json.loads(line)]

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def compare(ours: Side, theirs: Side, rounds: int, steps: int) -> dict[str, object]:
    """Return medians of both sides' parts, ms, and median and quartiles of the pairs' ratios.

    Args:
        ours, theirs: take turns.
        rounds: how many pairs.
        steps: of each turn.
    """
    for side in (ours, theirs):
        side.take(3)  # compiles, and draws the background
    pairs = [(ours.take(steps), theirs.take(steps)) for _ in range(rounds)]
    ratios = sorted(other[-1] / mine[-1] for mine, other in pairs)
    low, middle, high = statistics.quantiles(ratios, n=4)
    sides = {
        name: dict(zip(PARTS, (round(statistics.median(part), 2) for part in zip(*taken, strict=True)), strict=True))
        for name, taken in zip(("ours", "theirs"), zip(*pairs, strict=True), strict=True)
    }
    return {**sides, "ratio": round(middle, 3), "quartiles": [round(low, 3), round(high, 3)], "pairs": rounds}


def checkouts(
    folder: Annotated[Path, typer.Argument(help="Another checkout of this project.")],
    task: Annotated[str, typer.Option(help="Task to simulate.")] = TASK,
    quality: Annotated[str, typer.Option(help="Of the pictures.")] = "default",
    rounds: Annotated[int, typer.Option(help="Pairs of turns.")] = 24,
    steps: Annotated[int, typer.Option(help="Control steps of a turn.")] = 10,
) -> None:
    """Time a control step with two pictures of this checkout and of another, in pairs."""
    ours, theirs = Side(Path(__file__).parents[2], task, quality), Side(folder, task, quality)
    try:
        print(json.dumps({"task": task, "quality": quality, **compare(ours, theirs, rounds, steps)}))
    finally:
        ours.close()
        theirs.close()


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("speed.checkouts", checkouts, argv)


if __name__ == "__main__":
    sys.exit(main())
