"""Environments that repeat pictures, and policies that remember what they are shown."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.utils import preprocess_observation

from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.policies.remote.session import Row, Session
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.small_policy import small_config

FOLDER = str(get_task("turn_on_the_stove_and_turn_it_off").folder)


def _policy(**fields: Any) -> MemobenchMemPolicy:
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 256, 256))
    seen = {
        "observation.images.image": image,
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(8,)),
    }
    acts = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))}
    torch.manual_seed(0)
    return MemobenchMemPolicy(small_config(input_features=seen, output_features=acts, **fields)).eval()


def _observations(steps: int, **settings: Any) -> list[dict[str, Any]]:
    """What plain ``lerobot-eval`` hands on of an episode."""
    env = gym.vector.SyncVectorEnv([lambda: MemobenchEnv(FOLDER, render="fast", **settings)])
    found = [preprocess_observation(env.reset(seed=[7])[0])]
    for _ in range(steps):
        found.append(preprocess_observation(env.step(np.full((1, 7), 0.5, np.float32))[0]))
    env.close()
    return found


def _remember(policy: MemobenchMemPolicy, observations: list[dict[str, Any]]) -> Any:
    policy.reset()
    for observation in observations:
        policy.observe(observation)
    return policy.history.gather([0])


def test_a_frame_that_shows_an_earlier_step_is_not_remembered() -> None:
    every, third = _observations(7), _observations(7, render_every=3)
    policy = _policy()
    _remember(policy, every)
    with pytest.raises(MemobenchError, match=r"frame of step 1 shows step 0 again; leave env.render_every at 1"):
        _remember(policy, third)
    plain = _policy(memory_fusion="none")
    for observation in third:
        plain.observe(observation)  # looks at nothing between its plans
    # Where the frames that are remembered are drawn, the memory is that of an environment that draws them all.
    spread = _policy(memory_stride=3)
    for one, two in zip(_remember(spread, third), _remember(spread, every), strict=True):
        assert torch.equal(one, two)


def test_a_server_that_buffers_frames_is_not_sent_them_either() -> None:
    session = Session(RemoteConfig(dialect="robomme"), "ws://nowhere:1")
    first, second = _observations(1, render_every=3)
    session.watch(Row(first, 0))
    with pytest.raises(MemobenchError, match=r"step 1 shows step 0"):
        session.watch(Row(second, 0))
