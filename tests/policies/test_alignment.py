"""Alignment objectives against the paper's formulas, written out in numpy with loops."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.alignment import (
    FramewiseAlignment,
    make_alignment,
    retrieval_accuracy,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import OURS
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import batch_of, made_for_training

B, F, P, D, T = 5, 3, 4, 6, 7


def _inputs(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(seed)
    memory = torch.randn(B, F * P, D)
    frames = torch.tensor([[1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 1, 1], [1, 1, 0]], dtype=torch.bool)
    return memory, frames.repeat_interleave(P, dim=1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _pooled(module: torch.nn.Module, memory: torch.Tensor, mask: torch.Tensor) -> np.ndarray:
    weight, bias = module.project.weight.detach().numpy(), module.project.bias.detach().numpy()
    rows = [np.mean([memory[b, i].numpy() for i in range(F * P) if mask[b, i]], axis=0) for b in range(B)]
    return np.stack([_unit(weight @ row + bias) for row in rows])


def test_semantic() -> None:
    memory, mask = _inputs()
    text = torch.randn(B, T)
    module = make_alignment("semantic", D, T, F, P)
    assert module is not None
    z = _pooled(module, memory, mask)
    expected = np.mean([1 - z[b] @ _unit(text[b].numpy()) for b in range(B)])
    assert module(memory, mask, text).item() == pytest.approx(expected, abs=1e-5)


def test_contrastive_counts_repeated_subgoals_as_positives() -> None:
    memory, mask = _inputs()
    text = torch.randn(B, T)
    text[3] = 2.5 * text[0]  # the same direction is the same text
    module = make_alignment("contrastive", D, T, F, P)
    assert module is not None
    assert module.log_temperature.exp().item() == pytest.approx(0.07)
    module.log_temperature.data.fill_(math.log(0.3))
    z = _pooled(module, memory, mask)
    t = np.stack([_unit(row) for row in text.numpy()])
    logits = z @ t.T / 0.3
    positive = (t @ t.T > 0.99).astype(float)
    assert positive[0].tolist() == [1, 0, 0, 1, 0]
    target = positive / positive.sum(axis=1, keepdims=True)
    to_text = to_memory = 0.0
    for i in range(B):
        for j in range(B):
            to_text -= target[i, j] * (logits[i, j] - np.log(np.exp(logits[i]).sum())) / B
            to_memory -= target[j, i] * (logits[j, i] - np.log(np.exp(logits[:, i]).sum())) / B
    assert module(memory, mask, text).item() == pytest.approx(0.5 * (to_text + to_memory), abs=1e-5)


def test_contrastive_of_equal_memories_and_one_text_is_at_rest() -> None:
    """Were repeats negatives, a batch of one subgoal would push its equal memories about."""
    memory, mask = _inputs()
    memory, mask = memory[:1].expand(B, -1, -1), mask[:1].expand(B, -1)
    module = make_alignment("contrastive", D, T, F, P)
    assert module is not None
    loss = module(memory, mask, torch.randn(1, T).expand(B, T))
    loss.backward()
    assert loss.item() == pytest.approx(math.log(B), abs=1e-5)
    assert module.project.weight.grad.abs().max() < 1e-5


def test_framewise() -> None:
    memory, mask = _inputs()
    text, text_mask = torch.randn(B, F, T), torch.ones(B, F, dtype=torch.bool)
    text_mask[0, 1] = False
    text[0, 1] = float("nan")  # a frame without text may hold anything
    module = make_alignment("framewise", D, T, F, P)
    assert module is not None
    weight, bias = module.project.weight.detach().numpy(), module.project.bias.detach().numpy()
    above = below = 0.0
    for b in range(B):
        valid = [f for f in range(F) if mask[b, f * P] and text_mask[b, f]]
        for rank, f in enumerate(valid):
            u = memory[b, f * P : (f + 1) * P].numpy().mean(axis=0)
            alpha = 0.5 + 0.5 * rank / max(len(valid) - 1, 1)
            above += alpha * (1 - _unit(weight @ u + bias) @ _unit(text[b, f].numpy()))
            below += alpha
    loss = module(memory, mask, text, text_mask)
    assert loss.item() == pytest.approx(above / below, abs=1e-5)
    loss.backward()
    assert torch.isfinite(module.project.weight.grad).all()


def test_framewise_weights() -> None:
    valid = torch.tensor([[1, 0, 1, 1], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=torch.bool)
    expected = [[0.5, 0, 0.75, 1.0], [0, 0.5, 0, 0], [0, 0, 0, 0]]
    assert FramewiseAlignment.weights(valid).tolist() == expected


def test_nothing_to_align_is_zero_and_not_nan() -> None:
    memory, mask = _inputs()
    module = make_alignment("framewise", D, T, F, P)
    assert module is not None
    assert module(memory, torch.zeros_like(mask), torch.randn(B, F, T), torch.ones(B, F)).item() == 0.0


def test_gradient_reaches_memory() -> None:
    memory, mask = _inputs()
    for name in ("semantic", "contrastive", "framewise"):
        module = make_alignment(name, D, T, F, P)
        assert module is not None
        tokens = memory.clone().requires_grad_()
        text = torch.randn(B, F, T) if name == "framewise" else torch.randn(B, T)
        extra = (torch.ones(B, F, dtype=torch.bool),) if name == "framewise" else ()
        module(tokens, mask, text, *extra).backward()
        assert tokens.grad is not None
        assert tokens.grad[mask].abs().sum() > 0
        assert tokens.grad[~mask].abs().sum() == 0


def test_retrieval_accuracy() -> None:
    text = torch.eye(3)[[0, 1, 0]]
    assert retrieval_accuracy(torch.eye(3)[[0, 1, 0]], text) == 1.0
    assert retrieval_accuracy(torch.eye(3)[[1, 1, 0]], text) == pytest.approx(2 / 3)
    assert retrieval_accuracy(torch.zeros(0, 3), torch.zeros(0, 3)) == 0.0


def test_none_is_no_objective() -> None:
    assert make_alignment("none", D, T, F, P) is None


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_object_dataset(tmp_path_factory.mktemp("objects") / "data")


@pytest.mark.parametrize(
    ("memory", "align"),
    [
        *((name, align) for name in OURS for align in ("semantic", "contrastive") if name != "keyframes"),
        *((name, "framewise") for name in ("frames", "subgoal")),
    ],
)
@pytest.mark.slow
def test_every_memory_learns_to_tell_its_subgoal(memory: str, align: str, objects: Path) -> None:
    """Few updates on one batch: the loss falls, and the weights of what is remembered take part in it.

    The contrastive loss of equal texts cannot come near zero.
    """
    fields = {"size": "small", "perception": "objects", "memory_frames": 32}
    policy, before, _, dataset = made_for_training(objects, memory=memory, align=align, **fields)
    batch = before(batch_of(dataset, [10, 30, 50, 56, 75, 90]))
    optimizer, found = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3), []
    for _ in range(20):
        loss, logged = policy.train().forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        found.append(logged)
    assert found[-1]["align_loss"] < 0.9 * found[0]["align_loss"]
    assert all(logged["align_grad_norm"] > 0 for logged in found)


@pytest.mark.parametrize("align", ["semantic", "contrastive", "framewise"])
def test_a_memory_that_reads_the_text_itself_is_not_aligned_with_it(align: str) -> None:
    with pytest.raises(MemobenchError, match="memory=keyframes learns from that text already"):
        MemobenchMemConfig(device="cpu", memory="keyframes", align=align)
