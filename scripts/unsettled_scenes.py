"""List the published scenes in which an object is thrown, or still moves, before the first action.

    python scripts/unsettled_scenes.py

prints the table of ``results/unsettled_scenes.md`` for the paper's seeds, and how many strict scenes are drawn again.
It takes two minutes.

    PYTHONPATH=FOLDER:src python scripts/unsettled_scenes.py 3.4.0.npz
    python scripts/unsettled_scenes.py 3.9.0.npz
    python scripts/unsettled_scenes.py 3.9.0.npz 3.4.0.npz

writes the positions of the objects after settling, 25 seeds of each published task, under two versions of MuJoCo
(FOLDER: ``pip install --no-deps --target FOLDER mujoco==3.4.0``), and prints the largest and the median distance per
task, mm.
"""

from __future__ import annotations

import sys

import numpy as np

from lerobot_memobench.protocol import PAPER, SPLITS
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import PUBLISHED, STRICT


def unsettled(name: str, seeds: range | list[int]) -> list[int]:
    """Return the seeds of a task whose scenes do not settle."""
    sim = Simulation(get_task(name))
    found = []
    for seed in seeds:
        sim.reset(seed)
        if not sim.settled:
            found.append(seed)
    return found


def write_positions(file: str) -> None:
    """Write task -> positions of its objects after settling, (25, objects, 3), m."""
    found = {}
    for name in task_names(suite=PUBLISHED):
        sim = Simulation(get_task(name))
        found[name] = np.empty((25, len(sim.task.objects), 3))
        for k, seed in enumerate(SPLITS[PAPER][:25]):
            sim.reset(seed)
            found[name][k] = [sim.data.body(body).xpos for body in sim.task.objects]
    np.savez(file, **found)


def compare(first: str, second: str) -> None:
    """Print the largest and the median distance per task; that of a scene is its objects' largest, mm."""
    a, b = np.load(first), np.load(second)
    for name in a.files:
        distances = 1000 * np.linalg.norm(a[name] - b[name], axis=2).max(axis=1)
        print(f"| `{name}` | {distances.max():.2g} | {np.median(distances):.2g} |")


def main() -> None:
    """Print a row per task with such scenes; for strict tasks there must be none."""
    for suite in (PUBLISHED, STRICT):
        for name in task_names(suite=suite):
            if seeds := unsettled(name, SPLITS[PAPER]):
                print(f"| `{name}` | {len(seeds)} | {', '.join(map(str, seeds))} |", flush=True)


if __name__ == "__main__":
    (main, write_positions, compare)[len(sys.argv) - 1](*sys.argv[1:])
