"""Episodes that are in the log are not run again; the others see what they would have seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import EpisodeLog, read_episodes
from lerobot_memobench.errors import MemobenchError

TASK = "turn_on_the_stove_and_turn_it_off"
SEEDS = [7, 8, 9]


def vector(log_dir: Path, use_async: bool = False, resume: bool = True, **settings: Any) -> gym.vector.VectorEnv:
    config = MemobenchEnvConfig(tasks=TASK, log_dir=str(log_dir), resume=resume, **{"horizon": 3, **settings})
    return config.create_envs(len(SEEDS), use_async)["temporal"][6]


def log_episode(log_dir: Path, success: bool, episode: int = 1, **changes: Any) -> None:
    record = {
        "task": TASK,
        "memory_type": "temporal",
        "episode": episode,
        "seed": 7 + episode,
        "referent": "fixed",
        "success": success,
        "checkpoints": [],
        **changes,
    }
    EpisodeLog(log_dir).append(record)


def roll(env: gym.vector.VectorEnv) -> list[dict[str, Any]]:
    """Observations and outcomes of one batch, each row by itself."""
    observation, info = env.reset(seed=SEEDS, options={"lerobot_new_rollout": True})
    steps = [{"observation": observation["pixels"]["image"].copy(), "success": info["is_success"]}]
    for _ in range(3):
        observation, reward, terminated, truncated, info = env.step(np.full((len(SEEDS), 7), 0.5, np.float32))
        image, state = observation["pixels"]["image"].copy(), observation["agent_pos"].copy()
        steps.append(
            {
                "observation": image,
                "state": state,
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
            }
        )
    return steps


@pytest.mark.parametrize("use_async", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_logged_row_ends_at_once_and_the_others_are_what_they_were(tmp_path: Path, use_async: bool) -> None:
    whole = vector(tmp_path / "whole", resume=False)
    reference = roll(whole)
    whole.close()
    log_episode(tmp_path / "log", success=True)
    env = vector(tmp_path / "log", use_async)
    try:
        found = roll(env)
        shape = env.call("render")[0].shape
        assert env.call("render")[1].shape == shape
    finally:
        env.close()
    for before, after in zip(reference, found, strict=True):
        np.testing.assert_array_equal(after["observation"][[0, 2]], before["observation"][[0, 2]])
        assert not after["observation"][1].any()
    np.testing.assert_array_equal(found[3]["state"][[0, 2]], reference[3]["state"][[0, 2]])
    assert found[1]["terminated"].tolist() == [False, True, False]
    assert found[1]["reward"].tolist() == [0.0, 1.0, 0.0]
    assert found[3]["truncated"].tolist() == [True, False, True]
    records = read_episodes(tmp_path / "log")
    assert [record["episode"] for record in records] == [0, 1, 2]
    assert "wall_s" not in records[1]  # the line that was there
    assert [records[k]["scene_hash"] for k in (0, 2)] == [
        record["scene_hash"] for record in read_episodes(tmp_path / "whole") if record["episode"] != 1
    ]


def test_a_failure_stays_a_failure(tmp_path: Path) -> None:
    for episode in range(3):
        log_episode(tmp_path, success=False, episode=episode)
    env = vector(tmp_path)
    steps = roll(env)
    env.close()
    assert steps[1]["truncated"].all()
    assert not steps[1]["terminated"].any()
    assert len(list((tmp_path / "episodes").iterdir())) == 1


def test_other_tasks_referents_and_episodes_are_run(tmp_path: Path) -> None:
    log_episode(tmp_path, success=True, task="another")
    log_episode(tmp_path, success=True, referent="random")
    log_episode(tmp_path, success=True, episode=4)
    env = vector(tmp_path)
    steps = roll(env)
    env.close()
    assert steps[0]["observation"].any(axis=(1, 2, 3)).all()
    assert len(read_episodes(tmp_path)) == 6


def test_another_protocol_in_the_folder_is_told_before_anything_is_simulated(tmp_path: Path) -> None:
    env = vector(tmp_path)
    roll(env)
    env.close()
    with pytest.raises(MemobenchError, match="horizon: 3 and 4"):
        vector(tmp_path, horizon=4)
