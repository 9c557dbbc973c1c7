"""Pictures upright or as LIBERO's: environment, gymnasium, LeRobot's configuration, log, headline and comparison."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from lerobot.configs import FeatureType
from lerobot.envs import env_to_policy_features, preprocess_observation

import lerobot_memobench.envs  # noqa: F401
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import differences, read_log
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.protocol import EXECUTION, PROMPT

STOVE = "turn_on_the_stove_and_turn_it_off"
BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
REST = np.zeros(7, np.float32)
NAMES = ("image", "image2")


def opened(task: str = STOVE, **settings: Any) -> Any:
    return gym.make(f"memobench/{task}-v0", seed_base=20_000, **settings)


def test_libero_mirrors_and_names_what_the_policy_gets() -> None:
    """The prompt too; the frame for people stays upright."""
    envs = [opened(BUTTER), opened(BUTTER, convention="libero")]
    (upright, _), (mirrored, _) = (env.reset(seed=20_000) for env in envs)
    assert upright["phase"] == mirrored["phase"] == PROMPT
    for _ in range(2):
        assert tuple(mirrored["pixels"]) == NAMES
        assert envs[1].observation_space.contains(mirrored)
        for camera, name in zip(("image", "wrist_image"), NAMES, strict=True):
            assert np.array_equal(mirrored["pixels"][name], upright["pixels"][camera][:, ::-1])
            assert not np.array_equal(mirrored["pixels"][name], upright["pixels"][camera])
        assert np.array_equal(envs[0].render(), envs[1].render())
        upright, mirrored = (env.step(REST)[0] for env in envs)
    other = opened(BUTTER, convention="libero", prompt_in="reset")
    first, _ = other.reset(seed=20_000)
    assert first["phase"] == EXECUTION
    assert tuple(first["pixels"]) == NAMES


def test_lerobots_features_have_the_names() -> None:
    config = MemobenchEnvConfig(convention="libero")
    features = env_to_policy_features(config)
    pictures = [key for key, one in features.items() if one.type is FeatureType.VISUAL]
    assert pictures == [f"observation.images.{name}" for name in NAMES]
    env = MemobenchEnv(STOVE, config.settings)
    observed = preprocess_observation(copy.deepcopy(env.reset(seed=20_000)[0]))
    assert set(pictures) < set(observed)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"convention": "liberoo"}, "did you mean 'libero'"),
        ({"convention": "Upright"}, "did you mean 'upright'"),
        ({"control_mode": "absolute"}, "control_mode is 'absolute'; known are 'relative'"),
        ({"convention": "libero", "obs_type": "environment_state_agent_pos"}, "is of pictures"),
    ],
)
def test_refused_settings(settings: dict[str, Any], named: str) -> None:
    for make in (opened, MemobenchEnvConfig):
        with pytest.raises(MemobenchError, match=named):
            make(**settings)


def test_log_file_and_headline_name_the_convention(tmp_path: Path) -> None:
    for convention in ("upright", "libero"):
        env = MemobenchEnv(STOVE, log_dir=str(tmp_path / convention), convention=convention, horizon=1)
        env.reset(seed=7)
        env.step(REST)
        env.close()
    (line,) = read_log(tmp_path / "libero")
    assert line["convention"] == "libero"
    assert "convention" not in read_log(tmp_path / "upright")[0]
    upright, libero = (protocol_of(tmp_path / name) for name in ("upright", "libero"))
    assert (upright["convention"], libero["convention"]) == ("upright", "libero")
    assert differences(upright, libero) == ["convention: upright and libero"]
    del upright["convention"]  # of an earlier version
    assert differences(upright, libero) == ["convention: upright and libero"]
    runs = {name: read_runs([tmp_path / name]) for name in ("upright", "libero")}
    assert "convention libero" in headline(runs["libero"])
    assert "convention" not in headline(runs["upright"])
