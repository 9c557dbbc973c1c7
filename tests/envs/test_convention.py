"""Images upright or as LIBERO's: environment, gymnasium, LeRobot's configuration, log, headline and comparison."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import draccus
import gymnasium as gym
import numpy as np
import pytest
from lerobot.configs import FeatureType
from lerobot.envs import env_to_policy_features

import lerobot_memobench.envs  # noqa: F401
from lerobot_memobench.constants import EXECUTION, PROMPT
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode_log import read_log
from lerobot_memobench.envs.evaluation_file import OF_ONE_EVALUATION, differences
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.video import BAND
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import headline, read_runs
from tests.support.logs import protocol_of

STOVE = "turn_on_the_stove_and_turn_it_off"
BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
REST = np.zeros(7, np.float32)
NAMES = ("image", "image2")
MAPPING = {"agentview_image": "camera1", "robot0_eye_in_hand_image": "camera2"}


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


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"convention": "liberoo"}, "did you mean 'libero'"),
        ({"control_mode": "absolute"}, "control_mode is 'absolute'"),
        ({"convention": "libero", "obs_type": "environment_state_agent_pos"}, "is of images"),
        ({"observation_height": 360, "obs_type": "environment_state_agent_pos"}, "is of images"),
        ({"convention": "upright", "camera_name_mapping": MAPPING}, "convention is upright; set convention=libero"),
        ({"convention": "libero", "camera_name_mapping": {"agentview": "camera1"}}, "expected different names"),
        ({"convention": "libero", "camera_name_mapping": {"agentview_image": "image2"}}, "expected different names"),
        ({"observation_width": 15}, "observation_width is 15; expected a whole number from 16 on"),
        ({"observation_height": 361}, "are 361 and 256; expected even numbers up to 2048"),
    ],
)
def test_refused_settings(settings: dict[str, Any], named: str) -> None:
    for make in (opened, MemobenchEnvConfig):
        with pytest.raises(MemobenchError, match=named):
            make(**settings)


@pytest.mark.parametrize("render", ["default", "high"])
def test_sizes_of_images(tmp_path: Path, render: str) -> None:
    """Also not square: a narrower image is the middle of a wider one. Video and spaces follow."""
    small = {"observation_height": 16, "observation_width": 16}
    sizes = {"observation_height": 96, "observation_width": 64, "render": render}
    config = MemobenchEnvConfig(**sizes)
    features = env_to_policy_features(config)
    assert {one.shape for one in features.values() if one.type is FeatureType.VISUAL} == {(3, 96, 64)}
    narrow = opened(log_dir=str(tmp_path), videos=-1, horizon=1, **sizes)
    wide = opened(horizon=1, **sizes | {"observation_width": 96})
    (first, _), (other, _) = (env.reset(seed=20_000) for env in (narrow, wide))
    assert narrow.observation_space.contains(first)
    for name, image in first["pixels"].items():
        middle = other["pixels"][name][:, 16:80]
        assert image.shape == middle.shape == (96, 64, 3)
        assert np.abs(image.astype(int) - middle).mean() < 0.5
    narrow.step(REST)
    other = opened(horizon=1, **small)
    other.reset(seed=20_000)
    assert other.render().shape == (BAND + 16, 32, 3)
    with av.open(str(next(tmp_path.glob("videos/*.mp4")))) as video:
        assert (video.streams.video[0].height, video.streams.video[0].width) == (BAND + 96, 2 * 64)


def test_camera_name_mapping_names_the_images(tmp_path: Path) -> None:
    """As in LeRobot's libero: in its features, in observations, and through the parser of its commands."""
    wrist = {"robot0_eye_in_hand_image": "wrist"}
    for given, names in ((MAPPING, ("camera1", "camera2")), (wrist, ("image", "wrist"))):
        flags = ["--convention=libero", f"--camera_name_mapping={json.dumps(given)}"]
        config = draccus.parse(MemobenchEnvConfig, args=flags)
        features = env_to_policy_features(config)
        images = [key for key, one in features.items() if one.type is FeatureType.VISUAL]
        assert images == [f"observation.images.{name}" for name in names]
        env = MemobenchEnv(STOVE, config.settings, log_dir=str(tmp_path / names[0]), horizon=1)
        observed, _ = env.reset(seed=7)
        assert env.observation_space.contains(observed)
        usual, _ = MemobenchEnv(STOVE, convention="libero", horizon=1).reset(seed=7)
        for name, other in zip(names, NAMES, strict=True):
            assert np.array_equal(observed["pixels"][name], usual["pixels"][other])
        env.step(REST)
    assert read_log(tmp_path / "camera1")[0]["camera_name_mapping"] == MAPPING
    protocols = [protocol_of(tmp_path / name) for name in ("camera1", "image")]
    assert protocols[0]["camera_name_mapping"] == MAPPING
    assert [each.split(":")[0] for each in differences(*protocols)] == ["camera_name_mapping.robot0_eye_in_hand_image"]
    assert not differences(*protocols, ignore=OF_ONE_EVALUATION), "evaluations of two policies compare"


def test_log_file_headline_and_comparison_name_images(tmp_path: Path) -> None:
    sizes = {"observation_height": 128, "observation_width": 96}
    for name, settings in {"upright": {}, "libero": {"convention": "libero"} | sizes}.items():
        env = MemobenchEnv(STOVE, log_dir=str(tmp_path / name), horizon=1, **settings)
        env.reset(seed=7)
        env.step(REST)
        env.close()
    (line,) = read_log(tmp_path / "libero")
    assert line.items() >= {"convention": "libero", **sizes}.items()
    assert read_log(tmp_path / "upright")[0]["convention"] == "upright"
    found = ["convention: upright and libero", "observation_height: 256 and 128", "observation_width: 256 and 96"]
    assert differences(*(protocol_of(tmp_path / name) for name in ("upright", "libero"))) == found
    runs = {name: read_runs([tmp_path / name]) for name in ("upright", "libero")}
    assert "convention libero, observation_height 128, observation_width 96" in headline(runs["libero"])
    assert "convention" not in headline(runs["upright"])
