"""Episodes of the strict suite: drawn by seed whatever is asked for, and over when nothing can be mended."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode import Episode, first_execution_step, referent_of
from lerobot_memobench.envs.episode_log import IDLE, differences, read_episodes
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.settings import RESET
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.fixtures import turn_knob
from lerobot_memobench.experts.hand import OPEN, Hand
from lerobot_memobench.experts.travel import come_home
from lerobot_memobench.protocol import IDLE_STEPS
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom, Never
from lerobot_memobench.tasks.task import STRICT, Prompt, Task

STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"
ASSEMBLY = "assemble_strictly_in_the_order_demonstrated_in_the_prompt_video"
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)


def seed_of(name: str, variant: int) -> int:
    """The first seed for trying out that draws a variant."""
    task = get_task(name)
    return next(seed for seed in range(20_000, 20_100) if referent_of(task, seed).variant_index == variant)


@pytest.mark.parametrize("referent", ["fixed", "random"])
def test_every_episode_is_drawn_whatever_referent_is_asked_for(referent: str) -> None:
    env = MemobenchEnv(STOVE, referent=referent, render="fast")
    assert env.episode.referent == "drawn"
    for variant, words in enumerate(("once", "twice", "three times")):
        env.reset(seed=seed_of(STOVE, variant))
        assert env.episode.task.variant_index == variant
        assert env.task_description == f"turn the stove on and off {words}, leaving everything as it was"


@pytest.mark.parametrize("referent", ["fixed", "random", "drawn"])
def test_a_configuration_tells_what_is_true_of_its_suite(referent: str) -> None:
    config = MemobenchEnvConfig(suite=STRICT, referent=referent)
    assert config.referent == config.settings.protocol_block["referent"] == config.gym_kwargs["referent"] == "drawn"


def test_published_tasks_are_not_drawn() -> None:
    published = get_task(str(get_task(STOVE).derived_from))
    with pytest.raises(MemobenchError, match="referent is 'drawn'; did you mean"):
        Episode(published, referent="drawn")
    with pytest.raises(MemobenchError, match=r"referent is 'drawn'"):
        MemobenchEnvConfig(referent="drawn")


def test_a_variant_that_was_chosen_is_not_drawn_again() -> None:
    episode = Episode(get_task(STOVE).variant(2))
    assert episode.referent == "fixed"
    for seed in range(20_000, 20_003):
        episode.reset(seed)
        assert episode.task.variant_index == 2


def test_resting_at_once_ends_the_episode_and_is_logged_as_a_miscount(tmp_path: Path) -> None:
    env = MemobenchEnv(
        STOVE,
        log_dir=str(tmp_path),
        render="fast",
        prompt_in=RESET,
        seed_base=7,
    )
    env.reset(seed=20_000)
    for step in range(1, 41):
        *_, reward, terminated, truncated, info = env.step(REST)
        assert (terminated, truncated, reward) == (step == 40, False, 0.0)
    assert not info["is_success"]
    (record,) = read_episodes(tmp_path)
    assert (record["suite"], record["lost"], record["failure"], record["steps"]) == (STRICT, True, "miscount", 40)
    told = protocol_of(tmp_path)
    assert (told["suite"], told["referent"], record["referent"]) == (STRICT, "drawn", "drawn")


class Idle:
    """A prompt in which the arm stands at home for as long as is said."""

    shown, steps = True, 0

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None: ...

    def actions(self) -> Iterator[NDArray[np.float32]]:
        """Yield nothing but rest."""
        yield from [REST] * self.steps


@pytest.mark.parametrize("steps", [1, 60])
def test_rest_in_a_prompt_decides_nothing(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    monkeypatch.setattr(Idle, "steps", steps)
    monkeypatch.setattr("lerobot_memobench.envs.episode.PromptDemonstrator", Idle)
    prompt = Prompt("highlight", "moka_pot_1")
    episode = Episode(dataclasses.replace(get_task(STOVE).variant(0), prompt=prompt))
    episode.reset(20_000)
    while not episode.done:
        episode.step(REST)
    assert (episode.exec_steps, episode.lost) == (40, True)
    assert episode.exec_start == first_execution_step(episode.task, 20_000, True)


def rounds(episode: Episode, count: int) -> Iterator[NDArray[np.floating[Any]]]:
    """Turn the stove on and off, come home, so often; then rest."""
    hand, home = Hand(episode.sim, np.random.default_rng(0)), episode.sim.eef_pose()
    for _ in range(count):
        yield from turn_knob(hand, "flat_stove_1", on=True)
        yield from turn_knob(hand, "flat_stove_1", on=False)
        yield from come_home(hand, *home)
    while True:
        yield hand.rest(OPEN)


@pytest.mark.parametrize(
    ("asked", "done"),
    [(1, 2), (2, 2), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((1, 1), (2, 1)))],
)
def test_the_stove_as_often_as_asked_for(asked: int, done: int) -> None:
    episode = Episode(get_task(STOVE))
    episode.reset(seed_of(STOVE, asked - 1))
    while episode.exec_start is None:
        episode.step(REST)
    for action in rounds(episode, done):
        if episode.done:
            break
        episode.step(action)
    assert (episode.success, episode.lost) == (asked == done, asked != done)
    assert episode.exec_steps < episode.settings.horizon


def test_a_published_episode_goes_on_though_nothing_can_be_mended() -> None:
    """Its protocol is the paper's: success or the horizon."""
    never = Never(Atom("turnoff", ("flat_stove_1",)))
    lost = dataclasses.replace(get_task("turn_on_the_stove_and_turn_it_off"), goal=never)
    episode = Episode(lost, horizon=45)
    episode.reset(20_000)
    while not episode.done:
        episode.step(REST)
    assert (episode.progress.lost, episode.lost, episode.exec_steps) == (True, False, 45)


class Nudge:
    """A prompt of five steps that moves the butter by hand."""

    shown = True

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        self._sim = sim

    def actions(self) -> Iterator[NDArray[np.float32]]:
        """Yield nothing but rest."""
        for _ in range(5):
            self._sim.data.joint("butter_1_joint0").qpos[1] += 0.01
            yield REST


@pytest.mark.parametrize(
    ("prompt", "shown", "moved"),
    [
        (Prompt("highlight", "butter_1"), True, 0.0),
        (Prompt("highlight", "butter_1"), False, 0.0),
        (Prompt("hide", None, (("butter_1", "kitchen_table_plate_region"),)), True, 0.05),
        (Prompt("hide", None, (("butter_1", "kitchen_table_plate_region"),)), False, 0.05),
    ],
)
def test_the_execution_begins_where_a_hiding_ended_even_unseen(
    monkeypatch: pytest.MonkeyPatch, prompt: Prompt, shown: bool, moved: float
) -> None:
    monkeypatch.setattr("lerobot_memobench.envs.episode.PromptDemonstrator", Nudge)
    task = dataclasses.replace(get_task(ASSEMBLY), drawn=False, prompt=prompt)
    sim = Simulation(task)
    sim.reset(20_000)
    episode = Episode(task, demonstration_prompt=shown)
    episode.reset(20_000)
    while episode.exec_start is None:
        episode.step(REST)
    assert episode.exec_start == episode.step_index == first_execution_step(task, 20_000, shown)
    distance = np.linalg.norm(episode.sim.body_pose("butter_1")[0] - sim.body_pose("butter_1")[0])
    assert distance == pytest.approx(moved, abs=0.005)
    assert episode.sim.holds(Atom("inplace", ("butter_1",)))


def test_a_configuration_knows_its_suites_tasks(tmp_path: Path) -> None:
    assert [folder.name for *_, folder in MemobenchEnvConfig(suite=STRICT).selected()] == task_names(suite=STRICT)
    assert len(MemobenchEnvConfig().selected()) == 30
    with pytest.raises(MemobenchError, match=r"suite is 'strikt'"):
        MemobenchEnvConfig(suite="strikt")
    with pytest.raises(MemobenchError, match="set suite=strict, or --suite strict"):
        MemobenchEnvConfig(tasks=STOVE).selected()
    folder = str(get_task(STOVE).folder)
    with pytest.raises(MemobenchError, match=r"task of the strict suite and env\.suite is published; set suite=strict"):
        MemobenchEnvConfig(task_dir=folder).selected()
    assert len(MemobenchEnvConfig(task_dir=folder, suite=STRICT).selected()) == 1


def test_a_protocol_without_a_suite_is_the_published_ones() -> None:
    assert differences({"horizon": 5}, {"suite": "published", "horizon": 5}) == []
    assert differences({"horizon": 5}, {"suite": "strict", "horizon": 5}) == ["suite: published and strict"]
    assert differences({"suite": "strict"}, {}) == ["suite: strict and published"]


def test_strict_results_from_before_the_robot_idled_are_of_another_protocol() -> None:
    now = MemobenchEnvConfig(suite=STRICT).settings.protocol_block
    before = {key: value for key, value in now.items() if key != IDLE}
    assert differences(before, now) == [f"idle: 0 and {IDLE_STEPS}"]
    assert differences(now, before) == [f"idle: {IDLE_STEPS} and 0"]
    assert differences(now, now) == []
    assert IDLE not in MemobenchEnvConfig().settings.protocol_block
