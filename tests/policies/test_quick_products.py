"""Products in bfloat16 while a policy learns: where a CPU is quicker by them, when they are on, what is learned."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from lerobot_memobench.policies.memobench_mem import products
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import batch_of, made_for_training

OBJECTS = {"perception": "objects", "size": "small", "n_action_steps": 3, "memory_stride": 1}


@pytest.mark.parametrize(
    ("known", "quicker"),
    [
        ({}, False),
        ({"avx512_f": True, "avx512_bf16": False}, False),
        ({"avx512_bf16": True}, True),
        ({"avx512_bf16": True, "avx512_fp16": True}, False),
        ({"avx512_bf16": True, "avx512_fp16": True, "amx_bf16": True}, True),
    ],
)
def test_they_follow_from_the_instructions(
    known: dict[str, bool], quicker: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No stopwatch: the same machine learns the same, however busy it is."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known, raising=False)
    assert products.quicker_in_bfloat16() == quicker


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_object_dataset(tmp_path_factory.mktemp("objects") / "data")


def settings() -> tuple[str, bool]:
    return torch.backends.mkldnn.matmul.fp32_precision, torch.backends.cuda.flash_sdp_enabled()


@pytest.mark.parametrize("quick", [True, False])
def test_they_are_on_within_a_pass(root: Path, quick: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What another policy computes between a forward pass, its backward pass and its update, is computed as ever."""
    monkeypatch.setattr(products, "quicker_in_bfloat16", lambda: quick)
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    batch = before(batch_of(dataset, [10, 30, 50]))
    usual, during = settings(), ("bf16", False) if quick else settings()
    seen: list[tuple[str, bool]] = []
    policy.model.action_in_proj.register_forward_hook(lambda *_: seen.append(settings()))
    policy.model.action_in_proj.weight.register_hook(lambda _: seen.append(settings()))
    policy.eval().forward(batch)
    assert seen == [usual], "what measures a loss computes as everywhere"
    for reduction in ("mean", "none"):
        seen.clear()
        loss, _ = policy.train().forward(batch, reduction)
        assert (seen, settings()) == ([during], usual)
        loss.sum().backward()
        assert (seen, settings()) == ([during, during], usual)
    with pytest.raises(RuntimeError), products.quick_products():
        raise RuntimeError
    assert settings() == usual


class Noted(torch.autograd.Function):
    """Notes the settings in which its gradients are computed."""

    seen: ClassVar[list[tuple[str, bool]]] = []

    @staticmethod
    def forward(ctx: Any, tensor: torch.Tensor) -> torch.Tensor:
        return tensor.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> torch.Tensor:
        Noted.seen.append(settings())
        return gradients[0]


def test_an_operation_among_them_may_be_exact_both_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(products, "quicker_in_bfloat16", lambda: True)
    usual, first = settings(), torch.ones(2, requires_grad=True)
    with products.quick_products():
        with products.exact_products():
            assert settings() == ("ieee", True)
        assert settings() == ("bf16", False)
        exact = Noted.apply(first)
        products.exact_gradients(exact)
        loss = Noted.apply(exact).sum()
    products.quick_gradients(loss)
    Noted.seen.clear()
    loss.backward()
    assert (Noted.seen, settings()) == ([("bf16", False), ("ieee", True)], usual)


@pytest.mark.parametrize("memory", ["frames", pytest.param("subgoal", marks=pytest.mark.slow)])
def test_the_same_is_learned(memory: str, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients point the same way as with products in float32; on a CPU without bfloat16 they are equal."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS | {"align": "semantic", "memory": memory})
    batch = before(batch_of(dataset, list(range(8, 38)) * 8))
    found = []
    for on in (True, False):
        monkeypatch.setattr(products, "quicker_in_bfloat16", lambda on=on: on)
        policy.zero_grad()
        loss, _ = policy.train().forward(batch)
        loss.backward()
        policy.update()
        learned = [weight.grad for weight in policy.get_optim_params() if weight.grad is not None]
        gradients = torch.cat([gradient.flatten() for gradient in learned])
        found.append((loss.item(), gradients))
    (quick, quick_gradients), (usual, gradients) = found
    assert quick == pytest.approx(usual, rel=2e-3)
    assert torch.cosine_similarity(quick_gradients, gradients, dim=0) > 0.999
