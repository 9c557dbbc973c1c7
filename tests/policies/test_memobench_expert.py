"""The expert as a policy: LeRobot's factories make it from an environment's features, and it says what it lacks."""

from __future__ import annotations

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.configuration_baselines import MemobenchBlindConfig, MemobenchExpertConfig


class _EnvConfig:
    """What make_policy reads of an environment's configuration."""

    features = {
        "pixels/image": PolicyFeature(type=FeatureType.VISUAL, shape=(256, 256, 3)),
        "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(8,)),
        "action": PolicyFeature(type=FeatureType.ACTION, shape=(7,)),
    }
    features_map = {
        "pixels/image": "observation.images.image",
        "agent_pos": "observation.state",
        "action": "action",
    }


@pytest.mark.parametrize(
    ("config", "offered"), [(MemobenchExpertConfig(), "expert_action"), (MemobenchBlindConfig(), "blind_action")]
)
def test_action_passes_through_lerobots_pipeline(config: MemobenchExpertConfig, offered: str) -> None:
    policy = make_policy(config, env_cfg=_EnvConfig())  # type: ignore[arg-type]
    before, after = make_pre_post_processors(config)
    assert isinstance(policy, get_policy_class(config.type))
    assert not list(policy.parameters())
    expected = torch.rand(3, 7)
    observation = {
        "observation.images.image": torch.rand(3, 3, 8, 8),
        "observation.state": torch.rand(3, 8),
        f"observation.{offered}": expected,
        "task": ["a", "b", "c"],
    }
    policy.reset()
    assert torch.equal(after(policy.select_action(before(observation))), expected)
    assert policy.predict_action_chunk(observation).shape == (3, 1, 7)
    del observation[f"observation.{offered}"]
    with pytest.raises(MemobenchError, match=f"--env.{offered}=true"):
        policy.select_action(observation)


def test_it_cannot_be_trained() -> None:
    policy = get_policy_class("memobench_expert")(MemobenchExpertConfig())
    with pytest.raises(MemobenchError, match="cannot be trained"):
        policy.forward({})
