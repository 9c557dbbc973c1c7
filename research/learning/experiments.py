"""What is learned from what, by whom: the experiments, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from lerobot_memobench.protocol import EVALUATION_SEED
from lerobot_memobench.tasks.catalogue import DEMO_TASK, get_task, task_names
from lerobot_memobench.tasks.task import PUBLISHED

MEMORY, MEMORYLESS = "memory", "no memory"
ARMS: dict[str, tuple[str, ...]] = {MEMORY: (), MEMORYLESS: ("policy.memory_fusion=none",)}
"""Who is compared -> what is said of it to `lerobot train` beside what all share."""
ALIGNED = {**ARMS, MEMORY: ("align=semantic",)}
"""The same, with a memory aligned with checkpoint language, which learns referents in fewer updates."""

OBJECTS, DETECTIONS, PIXELS = "objects", "detections", "pixels"


@dataclass(frozen=True)
class Perception:
    """What policies observe: words for `lerobot train` and `lerobot eval`, and whether they learn from pictures."""

    training: tuple[str, ...]
    evaluation: tuple[str, ...] = ()
    pictures: bool = False


PERCEPTIONS = {
    OBJECTS: Perception(("perception=objects",)),
    DETECTIONS: Perception(("perception=objects", "policy.detection_noise=1"), ("detector=package",)),
    PIXELS: Perception(("perception=pixels",), pictures=True),
}
"""A policy that is to act by detections learns by privileged object state with their noise."""


@dataclass(frozen=True)
class Experiment:
    """Policies of equal data and updates, which differ in what their arm says.

    Attributes:
        tasks: task names, of one suite. episodes: demonstrations of each, two thirds of them with the arm moved off
            its way; 0 where they are given. prompted_episodes: of each that begins with a prompt; None: as many.
        steps: updates. pixel_steps: updates from pixels, where these are others.
        settings: more words for `lerobot train`, of all arms.
        arms: name -> words for `lerobot train`.
        perception: by what policies observe, of `PERCEPTIONS`.
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
    first_seed: int = EVALUATION_SEED
    referent: str = "random"
    prompted_episodes: int | None = None


def prompted() -> tuple[str, ...]:
    """Return the names of the tasks that begin with a prompt."""
    return tuple(name for name in task_names() if get_task(name).prompt is not None)


def experiment(name: str, perception: str = OBJECTS, suite: str = PUBLISHED) -> Experiment:
    """Return the experiment of a name in `EXPERIMENTS`, by policies with this perception, on a suite's tasks."""
    named = EXPERIMENTS[name]
    steps = (named.pixel_steps if PERCEPTIONS[perception].pictures else None) or named.steps
    tasks = tuple(task for task in task_names(suite=suite) if get_task(task).scene_name in named.tasks)
    return replace(named, perception=perception, steps=steps, tasks=tasks)


EXPERIMENTS: dict[str, Experiment] = {
    "bowl": Experiment((DEMO_TASK,), episodes=120, steps=1600, pixel_steps=2000, seeds=3),
    "prompted": Experiment(prompted(), episodes=240, steps=12_000, arms=ALIGNED),
    "joint": Experiment(
        tuple(task_names()),
        episodes=80,
        prompted_episodes=240,
        steps=36_000,
        settings=("policy.task_weights={prompted: 3}",),
        arms=ALIGNED,
    ),
}
"""Butter into the prompted bowl, in minutes; the ten prompted tasks, by one policy; all thirty, by one policy."""


def changed(which: Experiment, **given: object) -> Experiment:
    """Return an experiment with what is given, where it is not None, in place of its own."""
    return replace(which, **{key: value for key, value in given.items() if value is not None})  # type: ignore[arg-type]
