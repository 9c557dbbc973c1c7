"""The environment as gymnasium's users meet it: ids, checker, rewards, seeds, vector environments, bad input."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import lerobot_memobench.envs  # noqa: F401
from lerobot_memobench.envs import acting
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.observations import CHECKPOINTS, SPARSE
from lerobot_memobench.envs.settings import BOTH, OBJECTS
from lerobot_memobench.protocol import EXECUTION, IDLE_STEPS, PROMPT, PROMPT_HORIZON
from lerobot_memobench.sim.object_layout import BOUNDS, FIELDS
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.tasks.catalogue import get_task, task_names

STOVE = "turn_on_the_stove_and_turn_it_off"
HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
STRICT = "put_the_butter_only_into_the_bowl_from_the_prompt_video"


def make(name: str, **settings: Any) -> gym.Env[Any, Any]:
    return gym.make(f"memobench/{name}-v0", **{"obs_type": OBJECTS, **settings})


def test_each_task_of_both_suites_has_an_id() -> None:
    assert {f"memobench/{name.replace(',', '')}-v0" for name in task_names(suite=None)} <= set(gym.registry)


def test_the_module_may_stand_before_the_id() -> None:
    """Then gymnasium imports it, also in a process of its own that has not."""
    env = gym.make(f"lerobot_memobench.envs:memobench/{STOVE}-v0")
    assert env.unwrapped.task == STOVE
    env.close()


@pytest.mark.parametrize("name", [STOVE, STRICT])
def test_it_passes_gymnasiums_checker_without_a_warning(name: str) -> None:
    env = make(name, obs_type=BOTH, reward=CHECKPOINTS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


# --- rewards ---


def roll(env: gym.Env[Any, Any], steps: int) -> tuple[list[float], list[int], dict[str, Any]]:
    """Return the expert's rewards, after how many steps each came, and the last info."""
    observation, info = env.reset(seed=7)
    rewards = []
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(observation["expert_action"])
        rewards.append(float(reward))
        if terminated or truncated:
            break
    return rewards, [step for step, reward in enumerate(rewards, 1) if reward], info


def test_checkpoints_are_paid_once_each_in_order_and_success_as_much() -> None:
    env = make(STOVE, reward=CHECKPOINTS, expert_action=True)
    rewards, paid, info = roll(env, 400)
    ordered = env.unwrapped.episode.progress.ordered_step
    env.close()
    assert info["is_success"]
    assert paid == sorted({*ordered, len(rewards)}), "success ends the episode, in the step that is paid last"
    assert ordered[0] < ordered[1] == len(rewards)
    assert [rewards[step - 1] for step in paid] == pytest.approx([1 / 3, 2 / 3])

    cut = make(STOVE, reward=CHECKPOINTS, expert_action=True, horizon=ordered[0] + 1)
    rewards, paid, info = roll(cut, 400)
    cut.close()
    assert (paid, info["checkpoints_completed"], info["is_success"]) == ([ordered[0]], 1, False)
    assert sum(rewards) == pytest.approx(1 / 3)


@pytest.mark.parametrize(("kind", "paid"), [(SPARSE, 1.0), (CHECKPOINTS, 1 / 3)])
def test_success_ends_the_episode_and_is_paid_whatever_was_left_out(
    monkeypatch: pytest.MonkeyPatch, kind: str, paid: float
) -> None:
    env = make(STOVE, reward=kind)
    env.reset(seed=7)
    assert env.step(np.zeros(7, np.float32))[1:3] == (0.0, False)
    monkeypatch.setattr(Episode, "success", True)
    _, reward, terminated, _, info = env.step(np.zeros(7, np.float32))
    assert (terminated, info["checkpoints_completed"]) == (True, 0)
    assert reward == pytest.approx(paid)
    env.close()


# --- episodes ---


def test_the_horizon_truncates() -> None:
    env = make(STOVE, horizon=2)
    env.reset(seed=7)
    ends = [env.step(np.zeros(7, np.float32))[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    env.close()


@pytest.mark.parametrize(
    ("settings", "phase", "steps"),
    [({}, PROMPT, 66 + 2), ({"prompt_in": "reset"}, EXECUTION, 2), ({"demonstration_prompt": False}, EXECUTION, 2)],
)
def test_the_prompt_is_stepped_played_within_reset_or_left_out(
    settings: dict[str, Any], phase: int, steps: int
) -> None:
    """While it plays nothing is paid and the horizon does not count; the execution begins alike."""
    env = make(HIGHLIGHT, reward=CHECKPOINTS, horizon=2, **settings)
    observation, info = env.reset(seed=7)
    assert (observation["phase"], info["phase"]) == ([phase], phase)
    rewards, done = [], False
    while not done:
        observation, reward, terminated, done, info = env.step(np.zeros(7, np.float32))
        assert not terminated
        rewards.append(reward)
    assert observation["phase"] == [EXECUTION]
    assert rewards == [0.0] * steps
    env.close()


@pytest.mark.parametrize("mode", ["sync", pytest.param("async", marks=pytest.mark.slow)])
def test_vector_environments_have_the_scenes_of_the_benchmarks_seeds(mode: str) -> None:
    settings = {"obs_type": OBJECTS, "reward": CHECKPOINTS, "horizon": 2}
    workers = {"context": "forkserver"} if mode == "async" else {}  # this process has threads of torch's
    envs = gym.make_vec(f"memobench/{STOVE}-v0", num_envs=2, vectorization_mode=mode, vector_kwargs=workers, **settings)
    try:
        observation, _ = envs.reset(seed=7)
        scenes = envs.call("scene_hash")
        assert observation in envs.observation_space
        for done in (False, True):
            *_, terminated, truncated, _ = envs.step(np.zeros((2, 7), np.float32))
            assert (list(terminated), list(truncated)) == ([False, False], [done, done])
        envs.step(np.zeros((2, 7), np.float32))  # both begin again, in scenes that no protocol has
        assert not set(envs.call("scene_hash")) & set(scenes)
    finally:
        envs.close()
    episode = Episode(get_task(STOVE))
    for seed, scene in zip((7, 8), scenes, strict=True):
        episode.reset(seed)
        assert episode.scene_hash == scene


def test_a_seed_decides_which_scenes_follow_it() -> None:
    env = make(STOVE, horizon=1)
    followed = []
    for _ in range(2):
        env.reset(seed=7)
        followed.append([env.reset() and env.unwrapped.scene_hash() for _ in range(2)])
    assert followed[0] == followed[1]
    assert len(set(followed[0])) == 2
    env.close()


def test_an_observation_that_is_repeated_is_a_copy() -> None:
    env = make(STOVE)
    env.reset(seed=7)
    env.unwrapped.need_observation(False)
    one, two = (env.step(np.zeros(7, np.float32))[0]["environment_state"] for _ in range(2))
    assert (one == two).all()
    assert not np.shares_memory(one, two)
    env.close()


# --- spaces and settings ---


def test_every_space_is_bounded() -> None:
    space = MemobenchEnv(STOVE, obs_type=BOTH, horizon=5000).observation_space
    for part in (*space.spaces.values(), *space["pixels"].values()):
        assert isinstance(part, gym.spaces.Dict) or part.is_bounded()
    assert space["step"].high == [PROMPT_HORIZON + IDLE_STEPS + 5000]
    assert list(BOUNDS) == list(FIELDS)
    assert len(classes()) - 1 <= BOUNDS["class"][1]


def test_an_unknown_task_names_the_nearest() -> None:
    with pytest.raises(gym.error.NameNotFound, match=f"Did you mean: `{STOVE}`"):
        gym.make("memobench/turn_on_the_stofe_and_turn_it_off-v0")


@pytest.mark.parametrize("counted", [False, True])
def test_a_sealed_scene_is_logged_once_unless_its_run_is_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, counted: bool
) -> None:
    if counted:
        run = {"release": "1", "run": 1, "earlier": []}
        (tmp_path / EVALUATION_FILE).write_text(json.dumps({"protocol": {}, "sealed": run}))
    acting._log_sealed.cache_clear()
    env = MemobenchEnv(STOVE, log_dir=str(tmp_path), obs_type=OBJECTS)
    for seed, lines in ((7, 0), (100_006, 0), (100_007, 1), (100_056, 1), (100_057, 1)):
        env.reset(seed=seed)
        said = [record for record in caplog.records if "sealed scenes, not counted" in record.getMessage()]
        assert len(said) == (0 if counted else lines), seed
