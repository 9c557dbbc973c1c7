"""The baselines: LeRobot's factories make them; experts pass an observed action on; random actions are repeatable."""

from __future__ import annotations

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.configuration_baselines import (
    MemobenchBlindConfig,
    MemobenchExpertConfig,
    MemobenchRandomConfig,
    UntrainedConfig,
)

OFFERED = {"memobench_expert": "expert_action", "memobench_blind": "blind_action"}


class _EnvConfig:
    """What make_policy reads of an environment's configuration."""

    features = {
        "pixels/image": PolicyFeature(type=FeatureType.VISUAL, shape=(256, 256, 3)),
        "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(8,)),
        "action": PolicyFeature(type=FeatureType.ACTION, shape=(7,)),
    }
    features_map = {"pixels/image": "observation.images.image", "agent_pos": "observation.state", "action": "action"}


def observation(rows: int) -> dict[str, object]:
    return {"observation.state": torch.zeros(rows, 8), "task": ["a"] * rows}


@pytest.mark.parametrize("config", [MemobenchExpertConfig(), MemobenchBlindConfig(), MemobenchRandomConfig()])
def test_lerobots_factories_make_it(config: UntrainedConfig) -> None:
    policy = make_policy(config, env_cfg=_EnvConfig())  # type: ignore[arg-type]
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


def test_random_actions_are_uniform_in_the_box() -> None:
    actions = draws(2000)
    assert actions.abs().max() <= 1
    assert actions.mean((0, 1)).abs().max() < 0.03
    assert torch.allclose(actions.std((0, 1)), torch.tensor(3**-0.5), atol=0.02)  # of a uniform on [-1, 1]


def test_the_seed_decides_random_actions() -> None:
    assert torch.equal(draws(5, seed=3), draws(5, seed=3))
    assert not torch.equal(draws(5, seed=3), draws(5, seed=4))
    torch.manual_seed(0)
    first = draws(5)
    torch.manual_seed(1)
    assert torch.equal(first, draws(5))


def test_random_rollouts_and_rows_differ() -> None:
    policy = get_policy_class("memobench_random")(MemobenchRandomConfig())
    first = policy.select_action(observation(2))
    policy.reset()
    assert not torch.equal(first, policy.select_action(observation(2)))
    assert not torch.equal(first[0], first[1])


def test_smoothing_keeps_a_share_of_the_last_action() -> None:
    rough, smooth = draws(400), draws(400, smoothing=0.9)
    assert torch.allclose(smooth[1], 0.9 * smooth[0] + 0.1 * rough[1])
    assert smooth.diff(dim=0).abs().mean() < 0.2 * rough.diff(dim=0).abs().mean()
    assert smooth.abs().max() <= 1


@pytest.mark.parametrize(("settings", "name"), [({"smoothing": 1.0}, "smoothing"), ({"seed": -1}, "seed")])
def test_settings_out_of_range_are_refused(settings: dict[str, float], name: str) -> None:
    with pytest.raises(MemobenchError, match=rf"policy\.{name}"):
        MemobenchRandomConfig(**settings)  # type: ignore[arg-type]
