"""What is learned from what, by whom: the experiments, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from lerobot_memobench.tasks.catalogue import BOWL, get_task, task_names

MEMORY, MEMORYLESS = "memory", "no memory"
ARMS: dict[str, tuple[str, ...]] = {MEMORY: (), MEMORYLESS: ("policy.integration=none",)}
"""Who is compared -> what is said of it to `lerobot train` beside what all share."""

OBJECTS, PIXELS = "objects", "pixels"
PERCEPTIONS: dict[str, tuple[str, ...]] = {
    OBJECTS: ("perception=objects",),
    "found": ("perception=objects", "policy.eyes=package"),
    PIXELS: ("perception=pixels",),
}
"""By what policies see -> what is said of it to `lerobot train`; all but objects need pictures."""

EVALUATION_SEEDS = 7
TUNING_SEEDS = 20_000
"""First seeds: of the evaluation that is reported, and of one that settings may be chosen by."""


@dataclass(frozen=True)
class Experiment:
    """Policies of equal data and updates, which differ in what their arm says.

    Attributes:
        tasks: task names, of one suite. episodes: demonstrations of each, two thirds of them with the arm moved off
            its way; 0 where they are given.
        steps: updates. pixel_steps: updates from pixels, where these are others.
        settings: more words for `lerobot train`, of all arms.
        arms: name -> words for `lerobot train`.
        perception: by what policies see, of `PERCEPTIONS`.
        seeds: of training; the first ``seeds`` numbers.
        rollouts: of each task and policy. first_seed: of the rollouts. referent: of demonstrations and rollouts.
    """

    tasks: tuple[str, ...]
    episodes: int
    steps: int
    settings: tuple[str, ...] = ()
    arms: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: ARMS)
    perception: str = OBJECTS
    pixel_steps: int | None = None
    seeds: int = 1
    rollouts: int = 50
    first_seed: int = EVALUATION_SEEDS
    referent: str = "random"


def prompted() -> tuple[str, ...]:
    """Return the names of the tasks that begin with a prompt."""
    return tuple(name for name in task_names() if get_task(name).prompt is not None)


def experiment(name: str, perception: str = OBJECTS) -> Experiment:
    """Return the experiment of a name in `EXPERIMENTS`, by policies that see in this way."""
    named = EXPERIMENTS[name]
    steps = (named.pixel_steps if perception == PIXELS else None) or named.steps
    return replace(named, perception=perception, steps=steps)


EXPERIMENTS: dict[str, Experiment] = {
    "bowl": Experiment((BOWL,), episodes=120, steps=1000, pixel_steps=2000, seeds=3),
    "prompted": Experiment(prompted(), episodes=40, steps=8_000),
    "joint": Experiment(tuple(task_names()), episodes=40, steps=20_000),
}
"""Butter into the prompted bowl, in minutes; the ten prompted tasks, by one policy; all thirty, by one policy."""


def changed(which: Experiment, **given: object) -> Experiment:
    """Return an experiment with what is given, where it is not None, in place of its own."""
    return replace(which, **{key: value for key, value in given.items() if value is not None})  # type: ignore[arg-type]
