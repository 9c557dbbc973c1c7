"""Holds at home follow events alone, are longer than a plan and not observable, and do not depend on the variant."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.constants import HOLD_MEAN, LONGEST_HOLD, MOST_HOLDS
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.pacing import Pacing, shortest_hold
from lerobot_memobench.envs.settings import BOTH, EnvSettings
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom

COUNTING = "check_the_top_drawer_a_given_number_of_times"
THREE_DRAWERS = "check_all_three_drawers_once_each_in_the_given_order"
TOP, MIDDLE = "wooden_cabinet_1_top_region", "wooden_cabinet_1_middle_region"
OPEN = -0.15
"""Position of an open drawer, m."""
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
        drawn.append(list(episode.draw_holds()))
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


def test_holds_at_the_start_and_after_an_event_are_not_observable() -> None:
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
    for position in (0.0, OPEN, 0.0):
        _put(episode, {TOP: position})
        for _ in range(5):
            env.step(UP)
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


@pytest.mark.parametrize(("name", "variants"), [(COUNTING, range(3)), (THREE_DRAWERS, range(0, 6, 2))])
def test_a_hold_follows_an_event_and_the_return_to_the_scene_as_it_began(name: str, variants: range) -> None:
    """The same motion in each variant: an idle trip, a drawer opened, shut as another opens, and all shut."""
    episode, found = Episode(get_task(name)), set()
    for variant in variants:
        episode.reset(20_001, variant=variant)
        drawn = list(episode.draw_holds())
        lengths = [_held(episode)]
        for joints in ({}, {TOP: OPEN}, {TOP: 0.0, MIDDLE: OPEN}, {MIDDLE: 0.0}, {}):
            lengths.append(_trip(episode, joints))
        assert lengths == [drawn[0], 0, 0, 0, drawn[1], 0]
        found.add((episode.exec_steps, *lengths))
    assert len(found) == 1


def test_a_scene_that_becomes_as_it_began_at_home_is_held_after_an_event() -> None:
    episode = Episode(get_task(COUNTING))
    episode.reset(20_001)
    _held(episode)
    place = episode.sim.data.joint("akita_black_bowl_1_joint0").qpos
    for event in (False, True):
        place[0] += 0.003
        for joints in ({TOP: OPEN}, {TOP: 0.0}) if event else ({},):
            assert _trip(episode, joints) == 0
        place[0] -= 0.0025
        episode.step(REST)
        assert episode.sim.holds(Atom("asbegun", ()))
        assert episode.action_has_effect != event


def _trip(episode: Episode, joints: dict[str, float]) -> int:
    """Leave home, put joints to positions, return and wait; return the length of the hold."""
    for _ in range(8):
        episode.step(UP)
    _put(episode, joints)
    for _ in range(60):
        episode.step(_home(episode))
        if episode.sim.caught_at_home:
            break
    assert episode.sim.caught_at_home
    return _held(episode)


def _put(episode: Episode, joints: dict[str, float]) -> None:
    for name, position in joints.items():
        episode.sim.data.qpos[episode.sim.world.joints[name][1]] = position
    episode.step(UP)


def _home(episode: Episode) -> NDArray[np.float32]:
    """Return the action (7,) that moves the open hand home."""
    action = REST.copy()
    action[:3] = (episode.sim.home[0] - episode.sim.eef_pose()[0]) / 0.05
    return np.clip(action, -1, 1)


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
