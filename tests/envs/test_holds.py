"""Holds at home are longer than a plan, are not observable, and do not depend on the variant."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.pacing import Pacing, shortest_hold
from lerobot_memobench.envs.settings import BOTH, EnvSettings
from lerobot_memobench.protocol import HOLD_MEAN, LONGEST_HOLD, MOST_HOLDS
from lerobot_memobench.tasks.catalogue import get_task

COUNTING = "check_the_top_drawer_a_given_number_of_times"
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
UP = np.array([0, 0, 1, 0, 0, 0, -1], np.float32)


@pytest.mark.parametrize("replan", [1, 6, 10, 50])
@pytest.mark.parametrize(("window", "delay"), [(1, 0), (2, 0), (1, 4)])
@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_first_plan_with_an_effect_has_observed_home_alone(replan: int, window: int, delay: int, speed: float) -> None:
    """Simulate a policy that plans at each multiple of K steps from W frames and begins d steps later."""
    settings = EnvSettings(replan_steps=replan, window_steps=window, delay_steps=delay, speed=speed, suite="strict")
    length = replan * round(1 / speed)
    for arrival in range(1, length + 2):  # executed steps before the arrival
        pacing = Pacing(settings, np.random.default_rng(0))
        for _ in range(arrival):
            assert pacing.step(REST) is not None
        pacing.hold(0)
        step = arrival
        while pacing.step(REST) is None:
            step += 1
        assert step % length == 0  # a plan begins
        made = step - delay  # the plan that acts now, or an earlier one, observed frames from here on
        first_frame = made - (window - 1)
        assert first_frame >= arrival
        assert step - arrival < shortest_hold(settings) + length


def test_holds_are_heavy_tailed_and_do_not_depend_on_the_variant() -> None:
    episode = Episode(get_task(COUNTING), obs_type=BOTH)
    drawn = []
    for seed in range(20_000, 20_400):
        episode.seed = seed
        drawn.append(list(episode._draw_holds()))
    holds = np.array(drawn)
    assert holds.shape == (400, MOST_HOLDS)
    assert holds.min() >= 0
    assert holds.max() <= LONGEST_HOLD
    assert abs(holds[:, 0].mean() - LONGEST_HOLD / 2) < 300  # uniform
    assert abs(holds[:, 1:].mean() - HOLD_MEAN) < 25
    assert np.median(holds[:, 1:]) < HOLD_MEAN / 2
    assert abs(np.corrcoef(holds[:, 0], holds[:, 1])[0, 1]) < 0.2
    lengths = []
    for variant in (0, 1, 2):
        episode.reset(20_001, variant=variant)
        lengths.append(_held(episode))
    assert len(set(lengths)) == 1


def test_holds_at_the_start_and_after_each_return_are_not_observable() -> None:
    env = MemobenchEnv(COUNTING, obs_type=BOTH, replan_steps=5)
    first, _ = env.reset(seed=20_001)
    episode = env.episode
    assert not episode.action_has_effect
    started = 0
    while not episode.action_has_effect:
        seen, *_ = env.step(UP)
        started += 1
        _assert_equal(seen, first)
    assert started % 5 == 0
    assert episode.exec_steps == 0
    for _ in range(12):  # away, more than 5 cm
        seen, *_ = env.step(UP)
    assert episode.sim.is_away
    for _ in range(200):
        if not episode.action_has_effect:
            break
        seen, *_ = env.step(_home(episode))
    steps, held = episode.exec_steps, 0
    while not episode.action_has_effect:
        _assert_equal(seen, first)
        seen, *_ = env.step(UP)
        held += 1
    assert held >= shortest_hold(env.settings)
    assert episode.exec_steps == steps
    assert (started + steps + held) % 5 == 0
    env.close()


def test_a_hand_that_stays_near_home_is_not_held_again() -> None:
    episode = Episode(get_task(COUNTING))
    episode.reset(20_001)
    _held(episode)
    for action in (0.5 * UP - 0.5 * REST, REST, REST, -0.5 * UP + 1.5 * REST, REST, REST, REST, REST):
        episode.step(action)
        assert episode.action_has_effect


def test_a_turned_hand_is_away() -> None:
    episode = Episode(get_task(COUNTING))
    episode.reset(20_001)
    _held(episode)
    for _ in range(20):
        episode.step(_home(episode, turn=1.0))
        assert np.linalg.norm(episode.sim.eef_pose()[0] - episode.sim.home[0]) < 0.05
    assert episode.sim.is_away
    for _ in range(60):
        if not episode.action_has_effect:
            break
        episode.step(_home(episode, turn=-_turned(episode) / 0.5))
    assert not episode.action_has_effect


def test_a_mark_that_disappears_at_home_is_held() -> None:
    episode = Episode(get_task(COUNTING))
    episode.reset(20_001)
    _held(episode)
    place = episode.sim.data.joint("akita_black_bowl_1_joint0").qpos
    place[0] += 0.003
    for _ in range(3):
        episode.step(REST)
        assert episode.sim.caught_at_home
        assert episode.action_has_effect
    place[0] -= 0.0025
    episode.step(REST)
    assert not episode.action_has_effect


def _home(episode: Episode, turn: float = 0.0) -> NDArray[np.float32]:
    """Return the action (7,) that moves the open hand home, and turns it about the vertical."""
    action = REST.copy()
    action[:3] = (episode.sim.home[0] - episode.sim.eef_pose()[0]) / 0.05
    action[5] = turn
    return np.clip(action, -1, 1)


def _turned(episode: Episode) -> float:
    """Return the rotation of the hand from home about the vertical, rad."""
    turn = episode.sim.eef_pose()[1] @ episode.sim.home[1].T
    return float(np.arctan2(turn[1, 0], turn[0, 0]))


def _held(episode: Episode) -> int:
    steps = 0
    while not episode.action_has_effect:
        episode.step(UP)
        steps += 1
    return steps


def _assert_equal(seen: dict[str, NDArray[np.float32]], first: dict[str, NDArray[np.float32]]) -> None:
    for name, value in first.items():
        for part in value if isinstance(value, dict) else (None,):
            a, b = (seen[name][part], value[part]) if part else (seen[name], value)
            np.testing.assert_array_equal(a, b, err_msg=name)
