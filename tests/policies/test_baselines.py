"""Baselines: LeRobot's factories, actions from observations, random actions."""

from __future__ import annotations

import pytest
import torch
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class

from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines import (
    MemobenchBlindConfig,
    MemobenchExpertConfig,
    MemobenchRandomConfig,
    UntrainedConfig,
)

OFFERED = {"memobench_expert": "expert_action", "memobench_blind": "blind_action"}


def observation(rows: int) -> dict[str, object]:
    return {"observation.state": torch.zeros(rows, 8), "task": ["a"] * rows}


@pytest.mark.parametrize("config", [MemobenchExpertConfig(), MemobenchBlindConfig(), MemobenchRandomConfig()])
def test_lerobots_factories_make_it(config: UntrainedConfig) -> None:
    policy = make_policy(config, env_cfg=MemobenchEnvConfig())
    before, after = make_pre_post_processors(config)
    assert isinstance(policy, get_policy_class(config.type))
    assert not list(policy.parameters())
    expected, offered = torch.rand(3, 7), OFFERED.get(config.type)
    given = observation(3) | ({} if offered is None else {f"observation.{offered}": expected})
    policy.reset()
    action = after(policy.select_action(before(given)))
    assert (action.shape, action.dtype) == ((3, 7), torch.float32)
    assert policy.predict_action_chunk(given).shape == (3, 1, 7)
    with pytest.raises(MemobenchError, match="cannot be trained"):
        policy.forward({})
    if offered is not None:
        assert torch.equal(action, expected)
        with pytest.raises(MemobenchError, match=f"--env.{offered}=true"):
            policy.select_action(observation(3))


def draws(steps: int, rows: int = 4, **settings: float) -> torch.Tensor:
    """Random actions of one rollout, (steps, rows, 7)."""
    policy = get_policy_class("memobench_random")(MemobenchRandomConfig(**settings))
    policy.reset()
    return torch.stack([policy.select_action(observation(rows)) for _ in range(steps)])


def test_random_actions_are_uniform_and_repeatable() -> None:
    actions = draws(2000)
    assert actions.abs().max() <= 1
    assert actions.mean((0, 1)).abs().max() < 0.03
    assert torch.allclose(actions.std((0, 1)), torch.tensor(3**-0.5), atol=0.02)  # of a uniform on [-1, 1]
    torch.manual_seed(0)
    first = draws(5, seed=3)
    torch.manual_seed(1)
    assert torch.equal(first, draws(5, seed=3))
    assert not torch.equal(first, draws(5, seed=4))
    assert not torch.equal(first[:, 0], first[:, 1])
