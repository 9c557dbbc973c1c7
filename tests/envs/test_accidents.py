"""Nothing comes about by accident: who rests, who moves at random, and who repeats the published routine blindly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode, referent_of
from lerobot_memobench.protocol import HORIZON, PROMPT
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import PUBLISHED, STRICT, Task

SEED = 20_000
RESTING, MOVING = 120, 400
"""Execution steps; three times as long as any goal asks to rest (40), and 20 s of random motion."""
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
ALL = [*task_names(), *task_names(suite=STRICT)]
QUICK = ("check_the_top_drawer_a_given_number_of_times", "put_the_tomato_into_the_top_drawer_of_the_cabinet")

Policy = Callable[[Episode], NDArray[np.float32]]


def rolled(name: str, policy: Policy, steps: int, seed: int = SEED) -> Episode:
    """Return an episode after so many execution steps, or where it ended."""
    episode = Episode(get_task(name))
    episode.reset(seed)
    while episode.phase == PROMPT:
        episode.step(REST)
    while not episode.done and episode.exec_steps < steps:
        episode.step(policy(episode))
    assert episode.fault is None, "MuJoCo warned of its own state"
    return episode


@pytest.mark.parametrize("who", ["rests", "moves at random"])
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in ALL])
def test_no_checkpoint_comes_about_by_accident(name: str, who: str) -> None:
    rng = np.random.default_rng(SEED)
    if who == "rests":
        episode = rolled(name, lambda _: REST, RESTING)
    else:
        episode = rolled(name, lambda _: rng.uniform(-1, 1, 7).astype(np.float32), MOVING)
    assert episode.progress.first_step == [None] * len(episode.task.checkpoints)
    assert not episode.success


def seeds_of(task: Task) -> list[int]:
    """Return a seed whose episode asks for the published routine, and one whose does not, as far as there are."""
    first: dict[bool, int] = {}
    for seed in range(SEED, SEED + 100):
        first.setdefault(referent_of(task, seed).variant_index == 0, seed)
    return sorted(first.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_the_blind_routine_solves_what_asks_for_the_published_one_and_nothing_else(name: str) -> None:
    """Every published task. Of the strict ones no counting, order or finding one; of referents and procedures the
    episodes that happen to ask for what the published task asks for (results/strict_suite.md)."""
    task = get_task(name)
    if task.suite == PUBLISHED:
        assert rolled(name, Episode.blind_action, HORIZON).success
        return
    for seed in seeds_of(task):
        episode = rolled(name, Episode.blind_action, HORIZON, seed)
        asked = task.memory_type in ("object", "procedural") and episode.task.variant_index == 0
        assert episode.success == asked, seed
