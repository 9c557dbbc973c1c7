"""Compare control steps that observe objects, render both cameras' images, or do neither.

    python benchmarks/step_with_objects.py [--steps 60] [--repeats 9] [--tasks 4]

The scripted expert acts; the observation is computed at each step. Prints one JSON line: CPU milliseconds per step (all
threads), ``ratio`` of images to objects, and ``over_none`` of objects to no observation.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

from turns import medians

from lerobot_memobench.constants import VALIDATION_SEED
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.tasks.catalogue import get_task, task_names


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--tasks", type=int, default=4)
    args = parser.parse_args()
    names = task_names()
    observe: dict[str, Callable[[Episode], object]] = {
        "none": lambda episode: None,
        "objects": Episode.objects,
        "images": Episode.images,
    }
    milliseconds = dict.fromkeys(observe, 0.0)
    for name in names[:: max(1, len(names) // args.tasks)][: args.tasks]:
        steps = {
            kind: stepper(Episode(get_task(name), demonstration_prompt=False), function, args.steps)
            for kind, function in observe.items()
        }
        for kind, seconds in medians(steps, args.repeats).items():
            milliseconds[kind] += 1000 * seconds / args.steps / args.tasks
    result = {
        "benchmark": "step_with_objects",
        "tasks": args.tasks,
        **{f"{kind}_ms": round(value, 3) for kind, value in milliseconds.items()},
        "ratio": round(milliseconds["images"] / milliseconds["objects"], 2),
        "over_none": round(milliseconds["objects"] / milliseconds["none"], 2),
    }
    print(json.dumps(result))


def stepper(episode: Episode, observe: Callable[[Episode], object], steps: int) -> Callable[[], None]:
    """Return a function that takes some observed steps; each call continues the episode, or starts the next one."""
    episode.reset(VALIDATION_SEED)

    def take_steps() -> None:
        for _ in range(steps):
            if episode.done:
                episode.reset(VALIDATION_SEED)
            observe(episode)
            episode.step(episode.expert_action())

    return take_steps


if __name__ == "__main__":
    main()
