"""Pauses and slower actions: which of a policy's actions move the robot, and what of an episode stays as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.episode_log import differences, read_episodes
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.pacing import GAP, Pacing, longest
from lerobot_memobench.envs.settings import OBJECTS, EnvSettings
from lerobot_memobench.tasks.catalogue import get_task

STOVE = "turn_on_the_stove_and_turn_it_off"


def carried_out(pacing: Pacing, steps: int) -> list[float | None]:
    """The first number of what moves the robot at each control step, where action k is k + 1; None where it rests."""
    found: list[float | None] = []
    for step in range(steps):
        action = np.full(7, step + 1, np.float32)
        moved = pacing.step(action)
        found.append(None if moved is None else float(moved[0]))
        assert moved is None or moved[6] == np.ceil(moved[6])  # the gripper's part is never scaled
    return found


def paced(pause_steps: int = 0, speed: float = 1.0, replan_steps: int | None = None, seed: int = 0) -> Pacing:
    settings = EnvSettings(pause_steps=pause_steps, speed=speed, replan_steps=replan_steps)
    return Pacing(settings, np.random.default_rng(seed))


def test_unasked_every_action_is_carried_out_as_it_is() -> None:
    assert carried_out(paced(), 9) == [1, 2, 3, 4, 5, 6, 7, 8, 9]


def test_slower_each_action_takes_as_many_steps_and_ends_where_it_would() -> None:
    moved = carried_out(paced(speed=0.5), 8)
    assert moved == [0.5, 0.5, 1.5, 1.5, 2.5, 2.5, 3.5, 3.5]  # actions 1, 3, 5, 7: the others came while it moved


def test_slower_a_chunk_is_stretched_as_a_whole_and_those_planned_meanwhile_are_left() -> None:
    moved = carried_out(paced(speed=0.33, replan_steps=2), 12)
    assert np.allclose(np.array(moved, float) * 3, [1, 1, 1, 2, 2, 2, 7, 7, 7, 8, 8, 8])


@pytest.mark.parametrize(("speed", "replan"), [(1.0, None), (1.0, 7), (0.5, 7)])
def test_a_pause_begins_and_ends_where_a_chunk_does(speed: float, replan: int | None) -> None:
    chunk = replan or 1
    moved = carried_out(pacing := paced(100, speed, replan), 1500)
    rests = np.array([number is None for number in moved])
    edges = np.flatnonzero(np.diff(rests.astype(int))) + 1
    assert len(edges) > 4
    assert all(edge % chunk == 0 for edge in edges)
    begins, ends = edges[::2], edges[1::2]
    assert {int(length) for length in ends - begins[: len(ends)]} == {-(-100 // chunk) * chunk}
    gaps = np.diff([0, *edges])[::2]
    assert all(GAP[0] <= gap < GAP[1] + chunk * round(1 / speed) for gap in gaps)
    assert pacing.paused_steps == rests.sum()


def test_moments_are_drawn_by_the_seed() -> None:
    assert carried_out(paced(50), 400) == carried_out(paced(50), 400) != carried_out(paced(50, seed=1), 400)


def test_the_longest_execution_holds_every_pause() -> None:
    moved = carried_out(paced(30, 0.5, 4), longest(EnvSettings(horizon=600, pause_steps=30, speed=0.5, replan_steps=4)))
    assert sum(number is not None for number in moved) >= 600 * 2


# --- in an episode ---


def expert_episode(name: str, **settings: float) -> tuple[Episode, list[tuple[int, int, bool]], list[str]]:
    """An episode of the expert; of each step clock, execution steps and whether it rested; hashes of resting scenes."""
    episode = Episode(get_task(name), **settings)
    episode.reset(20_000)
    steps, hashes = [], []
    while not episode.done:
        episode.step(episode.expert_action())
        steps.append((episode.clock, episode.exec_steps, episode.rested))
        if episode.rested:
            hashes.append(episode.sim.scene_hash())
    return episode, steps, hashes


@pytest.fixture(scope="module")
def plain() -> Episode:
    """An episode of the expert without pauses, at full speed."""
    return expert_episode(STOVE)[0]


def test_in_a_pause_the_scene_stands_still_and_the_clock_goes_on(plain: Episode) -> None:
    episode, steps, hashes = expert_episode(STOVE, pause_steps=40)
    rested = [rests for *_, rests in steps]
    assert episode.success
    assert episode.pacing.paused_steps == sum(rested) >= 40
    assert len(set(hashes)) == sum(rested) // 40
    assert [clock for clock, *_ in steps] == list(range(1, len(steps) + 1))
    # What moves is the same to the last bit, and every checkpoint holds at the same execution step.
    assert episode.exec_steps == plain.exec_steps
    assert episode.progress.first_step == plain.progress.first_step
    assert episode.sim.scene_hash() == plain.sim.scene_hash()


def test_at_half_speed_the_expert_succeeds_and_takes_about_twice_as_long(plain: Episode) -> None:
    slow, _, _ = expert_episode(STOVE, speed=0.5)
    assert slow.success
    assert 1.5 < slow.exec_steps / plain.exec_steps < 2.5


def test_the_horizon_counts_actions_at_full_speed_and_waits_in_pauses() -> None:
    episode = Episode(get_task(STOVE), horizon=120, pause_steps=30, speed=0.5)
    episode.reset(20_000)
    count = 0
    while not episode.done:
        episode.step(np.zeros(7))
        count += 1
    assert episode.exec_steps == 240
    assert count == 240 + episode.pacing.paused_steps > 240
    assert episode.cut_off


def test_a_pause_is_observed_once_and_what_follows_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[int] = []
    objects = Episode.objects
    monkeypatch.setattr(Episode, "objects", lambda self: looked.append(self.step_index) or objects(self))
    env = MemobenchEnv(STOVE, obs_type=OBJECTS, horizon=200, pause_steps=30)
    env.reset(seed=7)
    rested = {0: False}
    over = False
    while not over:
        *_, over, _ = env.step(np.full(7, 0.1, np.float32))
        rested[env.episode.step_index] = env.episode.rested
    pauses = sum(rested[step] and not rested[step - 1] for step in rested if step)
    assert pauses > 1
    assert len(looked) == sum(not rests for rests in rested.values()) + pauses
    assert sum(rested[step] for step in looked) == pauses


def test_the_log_and_the_protocol_tell_the_pace(tmp_path: Path) -> None:
    env = MemobenchEnv(
        STOVE, obs_type=OBJECTS, horizon=60, pause_steps=10, speed=0.5, replan_steps=4, log_dir=str(tmp_path)
    )
    env.reset(seed=7)
    ended = False
    while not ended:
        _, _, terminated, ended, _ = env.step(np.zeros(7, np.float32))
        assert not terminated
    (record,) = read_episodes(tmp_path)
    assert record["steps"] == 120
    assert record["paused_steps"] % 12 == 0
    assert (
        0 < record["paused_steps"] <= longest(EnvSettings(horizon=60, pause_steps=10, speed=0.5, replan_steps=4)) - 120
    )
    told = protocol_of(tmp_path)
    assert (told["pause_steps"], told["speed"]) == (10, 0.5)
    before = {key: value for key, value in told.items() if key not in ("pause_steps", "speed")}
    assert differences(before, told) == ["pause_steps: 0 and 10", "speed: 1.0 and 0.5"]
    assert differences(before, {**told, "pause_steps": 0, "speed": 1.0}) == []
