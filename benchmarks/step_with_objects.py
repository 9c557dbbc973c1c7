"""A control step that sees the visible objects, beside one that sees both cameras' pictures and one that sees nothing.

    python benchmarks/step_with_objects.py [--steps 60] [--repeats 9] [--tasks 4]

Actions are the expert's; the observation is made at every step. Seconds are of the CPU, all threads. Prints one JSON
line: milliseconds per step, and ratios of the pictures' step and of the objects' to the others.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

from turns import medians

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.protocol import VALIDATION_SEED
from lerobot_memobench.tasks.catalogue import get_task, task_names


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--tasks", type=int, default=4)
    asked = parser.parse_args()
    names = task_names()
    looks: dict[str, Callable[[Episode], object]] = {
        "none": lambda episode: None,
        "objects": Episode.objects,
        "pictures": Episode.images,
    }
    seconds = dict.fromkeys(looks, 0.0)
    for name in names[:: max(1, len(names) // asked.tasks)][: asked.tasks]:
        episodes = {look: Episode(get_task(name), demonstration_prompt=False) for look in looks}
        sides = {look: stepper(episodes[look], see, asked.steps) for look, see in looks.items()}
        for look, taken in medians(sides, asked.repeats).items():
            seconds[look] += 1000 * taken / asked.steps / asked.tasks
    print(
        json.dumps(
            {
                "benchmark": "step_with_objects",
                "tasks": asked.tasks,
                **{f"{look}_ms": round(taken, 3) for look, taken in seconds.items()},
                "ratio": round(seconds["pictures"] / seconds["objects"], 2),
                "over_none": round(seconds["objects"] / seconds["none"], 2),
            }
        )
    )


def stepper(episode: Episode, see: Callable[[Episode], object], steps: int) -> Callable[[], None]:
    """Return a function that takes some steps of an episode, looking at each; a new one begins where it ended."""
    episode.reset(VALIDATION_SEED)

    def take() -> None:
        for _ in range(steps):
            if episode.done:
                episode.reset(VALIDATION_SEED)
            see(episode)
            episode.step(episode.expert_action())

    return take


if __name__ == "__main__":
    main()
