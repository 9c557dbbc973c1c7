"""bfloat16: what learns is float32, and what acts is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.support.small_policy import batch_of, made_for_training


@pytest.fixture(scope="module")
def half(dataset_root: Path) -> Any:
    """Policy in bfloat16 after three updates that are smaller than its weights' last bit; its weights before."""
    policy, before, after, dataset = made_for_training(dataset_root, dtype="bfloat16", optimizer_lr=1e-6)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    weights = {name: parameter.detach().clone() for name, parameter in policy.named_parameters()}
    moving: dict[str, torch.Tensor] = {}
    for indices in ([3, 50], [10, 70], [20, 90]):
        policy.forward(before(batch_of(dataset, indices)))[0].backward()
        for name, parameter in policy.named_parameters():
            if parameter.grad is not None:
                moving[name] = moving.get(name, False) | (parameter.grad != 0)
        optimizer.step()
        optimizer.zero_grad()
    return policy, before, after, dataset, weights, moving


def test_what_learns_is_float32_and_what_is_frozen_is_not(half: Any, dataset_root: Path) -> None:
    policy = half[0]
    assert {parameter.dtype for parameter in policy.get_optim_params()} == {torch.float32}
    frozen = {name: p.dtype for name, p in policy.named_parameters() if not p.requires_grad}
    assert frozen["model.paligemma_with_expert.gemma_expert.lm_head.weight"] == torch.bfloat16
    assert frozen["model.paligemma_with_expert.paligemma.model.multi_modal_projector.linear.weight"] == torch.float32
    expert, *_ = made_for_training(dataset_root, dtype="bfloat16", train_expert_only=True)
    vlm = expert.model.paligemma_with_expert.paligemma.model.language_model.layers[0].self_attn.q_proj.weight
    assert vlm.dtype == torch.bfloat16
    assert {parameter.dtype for parameter in expert.get_optim_params()} == {torch.float32}


def test_small_updates_accumulate(half: Any) -> None:
    policy, _, _, _, weights, moving = half
    moved = {
        name: (parameter.detach() != weights[name])[moving[name]].float().mean().item()
        for name, parameter in policy.named_parameters()
        if name in moving and moving[name].any() and ".language_model.layers." in name and "proj" in name
    }
    assert len(moved) > 10
    assert min(moved.values()) > 0.95, moved
