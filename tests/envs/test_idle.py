"""The robot of a strict task idles before the execution, so that the step does not tell what has been done."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.envs.episode import Episode, first_execution_step, referent_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.settings import BOTH, RESET
from lerobot_memobench.protocol import ACTION_DIM, ENDED, EXECUTION, IDLE_STEPS, NO_CLOCK, PROMPT, PROMPT_HORIZON
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names

STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"
HIGHLIGHT = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
SEEDS = range(20_000, 20_600)
ACTION = np.full(ACTION_DIM, 0.7, np.float32)


def idle(name: str, seed: int) -> int:
    """Return how long the robot idles."""
    return first_execution_step(get_task(name), seed, False)


def seed_of(name: str, low: int, high: int) -> int:
    """Return the first seed for trying out whose robot idles so long."""
    return next(seed for seed in SEEDS if low <= idle(name, seed) <= high)


def test_how_long_is_drawn_uniformly_and_apart_from_the_variant() -> None:
    steps = np.array([idle(STOVE, seed) for seed in SEEDS])
    assert 0 <= steps.min() < 20
    assert IDLE_STEPS - 20 < steps.max() <= IDLE_STEPS
    assert np.abs(np.quantile(steps, [0.25, 0.5, 0.75]) / IDLE_STEPS - [0.25, 0.5, 0.75]).max() < 0.05
    variants = np.array([referent_of(get_task(STOVE), seed).variant_index for seed in SEEDS])
    for variant in range(3):
        assert abs(steps[variants == variant].mean() - IDLE_STEPS / 2) < IDLE_STEPS / 20
        chosen = get_task(STOVE).variant(variant)
        assert first_execution_step(chosen, SEEDS[0], True) == first_execution_step(get_task(STOVE), SEEDS[0], True)


@pytest.mark.parametrize("suite", ["published", "strict"])
def test_prompts_have_one_length_in_strict_tasks_alone(suite: str) -> None:
    for task in map(get_task, task_names(suite=suite)):
        lengths = {task.variant(k).prompt_steps for k in task.random_variants}
        assert lengths == {task.prompt_steps}
        assert task.idles == (suite == "strict") == (task.prompt_steps is not None)
        assert (task.prompt_steps or 0) <= PROMPT_HORIZON
        assert first_execution_step(task, 20_000, True) - first_execution_step(task, 20_000, False) == (
            task.prompt_steps or 0
        )


@pytest.mark.parametrize("name", [STOVE, HIGHLIGHT])
def test_actions_have_no_effect_and_nothing_is_simulated_while_it_idles(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = {"step": 0, "render": 0}

    def counting(method: str) -> Callable[..., Any]:
        how = getattr(Simulation, method)

        def counted(sim: Simulation, *args: Any) -> Any:
            calls[method] += 1
            return how(sim, *args)

        return counted

    for method in calls:
        monkeypatch.setattr(Simulation, method, counting(method))
    seed = seed_of(name, 30, 90)
    begins = first_execution_step(get_task(name), seed, True)
    env = MemobenchEnv(name, obs_type=BOTH, render="fast", horizon=3)
    seen, _ = env.reset(seed=seed)
    calls["step"] = 0
    told, scenes, drawn = [seen], [env.scene_hash()], [calls["render"]]
    while seen["phase"] == [PROMPT]:
        seen, _, terminated, truncated, _ = env.step(ACTION)
        assert (terminated, truncated) == (False, False)
        told.append(seen)
        scenes.append(env.scene_hash())
        drawn.append(calls["render"])
    assert [int(one["step"][0]) for one in told] == [*range(begins), NO_CLOCK]
    assert all(env.observation_space.contains(one) for one in (told[0], told[-1]))
    rest = calls["step"]  # so many frames were simulated: the prompt's
    assert (rest == 0) == (get_task(name).prompt is None)
    assert rest <= begins - 30
    assert len(set(scenes[rest:])) == 1
    assert drawn[rest] == drawn[begins - 1] == drawn[begins] - 2, "it is drawn when it comes to rest, and when it acts"
    for part in ("environment_state", "agent_pos"):
        np.testing.assert_array_equal(told[rest][part], seen[part])
    for camera, picture in seen["pixels"].items():
        np.testing.assert_array_equal(told[rest]["pixels"][camera], picture)
    for step in range(1, 4):
        assert not truncated
        seen, _, _, truncated, _ = env.step(ACTION)
        assert (seen["step"], seen["phase"]) == ([ENDED if step == 3 else NO_CLOCK], [EXECUTION])
    assert truncated
    assert (env.record()["prompt_steps"], env.record()["steps"]) == (begins, 3)
    assert begins + 3 <= env._max_episode_steps == (get_task(name).prompt_steps or 0) + IDLE_STEPS + 3
    env.close()


@pytest.mark.parametrize("shown", [True, False])
def test_idling_within_reset_ends_at_the_same_frame(shown: bool) -> None:
    seed, observations = seed_of(HIGHLIGHT, 10, 60), []
    for where in ("steps", RESET):
        env = MemobenchEnv(
            HIGHLIGHT, obs_type="environment_state_agent_pos", demonstration_prompt=shown, prompt_in=where, horizon=5
        )
        seen, info = env.reset(seed=seed)
        assert (info["phase"] == EXECUTION) == (where == RESET)
        assert env._max_episode_steps == 5 + (where != RESET) * (IDLE_STEPS + shown * (env._task.prompt_steps or 0))
        while seen["phase"] == [PROMPT]:
            seen, *_ = env.step(ACTION)
        observations.append(seen)
        env.close()
    for part, value in observations[0].items():
        np.testing.assert_array_equal(value, observations[1][part])
    assert observations[0]["step"] == [NO_CLOCK]


def test_published_episodes_begin_at_once_and_their_step_begins_anew() -> None:
    episode = Episode(get_task(str(get_task(HIGHLIGHT).derived_from)))
    episode.reset(20_000)
    steps = [episode.clock]
    while episode.phase == PROMPT:
        assert not episode.idling
        episode.step(ACTION)
        steps.append(episode.clock)
    assert steps[-1] == 0
    assert all(later == step + 1 for step, later in pairwise(steps[:-1]))
