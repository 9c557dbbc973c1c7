"""The authors' evaluation and the paper's world, as far as no simulator of it is needed: asked, ended, logged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.episode_log import episode_record
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import EXECUTION
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.failures import asks_order
from lerobot_memobench.tasks.formula import Atom, Formula, Then, atoms
from lerobot_memobench.tasks.progress import HOLD_STEPS, Progress
from lerobot_memobench.tasks.task import LIBERO, STRICT, Task

DRAWER = "check_the_top_drawer_of_the_cabinet"
TOP = "wooden_cabinet_1_top_region"
SHUT, OPEN = Atom("close", (TOP,)), Atom("open", (TOP,))
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)


def drawer(goal: Formula, checkpoint: Formula = OPEN) -> Task:
    """The task with another goal and checkpoint; its drawer is shut from the start."""
    task = get_task(DRAWER)
    return replace(task, goal=goal, checkpoints=(replace(task.checkpoints[0], goal=checkpoint),))


def rested(task: Task, protocol: str, **settings: Any) -> Episode:
    episode = Episode(task, protocol=protocol, **settings)
    episode.reset(7)
    assert episode.phase == EXECUTION
    while not episode.done:
        episode.step(REST)
    return episode


def test_the_clock_of_then_runs_while_the_scene_settles_and_twice_per_step() -> None:
    three_times = drawer(Then((SHUT, SHUT, SHUT)))
    assert rested(three_times, "paper").exec_steps == 30
    assert rested(three_times, "upstream").exec_steps == 15 - 10


def test_an_episode_ends_when_all_checkpoints_have_held_there_alone() -> None:
    never, at_once = OPEN, SHUT
    theirs = rested(drawer(never, at_once), "upstream")
    assert (theirs.exec_steps, theirs.success, theirs.closed) == (1, False, True)
    assert episode_record(theirs, 0, 0.1)["failure"] == "execution_failure"
    ours = rested(drawer(never, at_once), "paper", horizon=3)
    assert (ours.exec_steps, ours.closed) == (3, False)


def test_there_is_no_prompt_and_a_log_says_so(tmp_path: Path) -> None:
    name = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
    env = MemobenchEnv(name, protocol="upstream", obs_type="environment_state_agent_pos", log_dir=str(tmp_path))
    assert env._max_episode_steps == 990
    observation, _ = env.reset(seed=7)
    assert observation["phase"] == EXECUTION
    line = env.record()
    assert (line["protocol"], "world" in line, line["prompt_steps"]) == ("upstream", False, 0)
    short = MemobenchEnv(
        name, protocol="upstream", obs_type="environment_state_agent_pos", horizon=1, log_dir=str(tmp_path)
    )
    short.reset(seed=7)
    assert short.step(REST)[3]
    told = protocol_of(tmp_path)
    assert (told["protocol"], told["horizon"], told["demonstration_prompt"]) == ("upstream", 1, False)


def test_a_line_of_the_papers_world_names_world_and_stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = Episode(get_task(DRAWER))
    episode.reset(7)
    assert not {"world", "stand_ins", "protocol"} & set(episode_record(episode, 0, 0.1))
    episode.task = episode.task.in_world(LIBERO)
    monkeypatch.setattr(episode.sim, "stand_ins", ("cork__3",), raising=False)
    line = episode_record(episode, 0, 0.1)
    assert (line["world"], line["stand_ins"]) == ("libero", ["cork__3"])


def test_strict_tasks_are_not_of_the_papers_world() -> None:
    with pytest.raises(MemobenchError, match="world=libero was asked for with suite=strict"):
        MemobenchEnvConfig(suite=STRICT, world=LIBERO)
    with pytest.raises(MemobenchError, match="world=libero was asked for with suite=strict"):
        MemobenchEnv("check_the_top_drawer_a_given_number_of_times", world=LIBERO)


@pytest.mark.parametrize("name", [each for each in task_names() if asks_order(get_task(each).goal)])
def test_goals_in_an_order_cannot_be_reached_there(name: str) -> None:
    """When the last part of `Then` begins to hold all checkpoints have held: docs/benchmark/fidelity.md says so."""
    task = get_task(name)
    progress = Progress(task, evaluations=2)
    world = [atom for checkpoint in task.checkpoints for atom in atoms(checkpoint.goal)]
    for atom in world:  # one after the other, each for as long as it is asked for
        for _ in range(HOLD_STEPS):
            progress.step({atom}.__contains__)
            if None not in progress.first_step:
                break
    assert None not in progress.first_step
    assert not progress.success
