"""objective=regression: what is learned is what a plan of one pass then does, and nothing is drawn."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import batch_of, losses_in_training, made_for_training

REGRESSION: dict[str, Any] = {"perception": "objects", "size": "small", "objective": "regression", "n_action_steps": 3}
INDICES = [*range(8, 38, 3)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, dict[str, Any], list[float]]:
    """A policy after some updates on one batch, that batch, and how the loss fell."""
    root = make_object_dataset(tmp_path_factory.mktemp("objects") / "data")
    policy, before, _, dataset = made_for_training(root, **REGRESSION, ema_decay=0.0)
    batch = before(batch_of(dataset, INDICES))
    losses = losses_in_training(policy, batch)
    return policy.eval(), batch, losses


def planned(policy: Any, batch: dict[str, Any]) -> torch.Tensor:
    with torch.no_grad():
        policy._read_memory(batch)
        rows = len(batch["action"])
        return policy.model.sample_actions(
            *policy._preprocess_images(batch),
            batch["observation.language.tokens"],
            batch["observation.language.attention_mask"],
            noise=policy._noise([*range(rows)], [0] * rows),
        )[:, :, : policy._action_dim]


def test_the_loss_is_the_plans_error(trained: tuple[Any, dict[str, Any], list[float]]) -> None:
    policy, batch, losses = trained
    assert losses[-1] < 0.5 * losses[0]
    plans = planned(policy, batch)
    with torch.no_grad():
        _, logged = policy.forward(batch)
    error = (plans - batch["action"]).abs()[~batch["action_is_pad"]]
    error = error + error.square()
    assert logged["action_loss"] == pytest.approx(error.mean().item(), abs=2e-3)  # below 0.001 the error bends
    assert logged["loss_per_dim"] == pytest.approx(error.mean(dim=0).tolist(), abs=2e-3)


def test_nothing_is_drawn(trained: tuple[Any, dict[str, Any], list[float]]) -> None:
    policy, batch, _ = trained
    torch.manual_seed(1)
    one, first = planned(policy, batch), policy.forward(batch)[0]
    torch.manual_seed(2)
    assert torch.equal(one, planned(policy, batch))
    assert torch.equal(first, policy.forward(batch)[0])
    assert policy.config.num_inference_steps == 1


def test_what_guides_denoising_is_refused() -> None:
    from lerobot.policies.rtc.configuration_rtc import RTCConfig

    with pytest.raises(MemobenchError, match="objective=flow_matching"):
        MemobenchMemConfig(device="cpu", objective="regression", rtc_config=RTCConfig())
    with pytest.raises(MemobenchError, match="objective=<one of flow_matching, regression>"):
        MemobenchMemConfig(device="cpu", objective="l2")
