"""Fast weights: the inner step equals autograd's, and the outputs that a chunk reads."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import softplus

from lerobot_memobench.policies.memobench_mem.memory import read_settings
from lerobot_memobench.policies.memobench_mem.memory.fast_weights import (
    BASE_RATE,
    FRAMES_READ,
    HEADS,
    MAX_RATE,
    MAX_STEP,
    FastWeights,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories, MemorySpec

SPEC = MemorySpec(dim=12, tokens=3, width=12, expert=16, grid=0, stride=16)


def made(std: float = 0.5, **changed: Any) -> FastWeights:
    """Build a mechanism in float64 with large weights."""
    torch.manual_seed(0)
    mechanism = FastWeights(SPEC, torch.nn.Identity(), read_settings("fast_weights", changed)).double()
    for name, weight in mechanism.named_parameters():
        if name != "rate.bias":
            torch.nn.init.normal_(weight, std=std)
    return mechanism


def normed(x: Tensor, norm: torch.nn.LayerNorm) -> Tensor:
    """Return the layer norm of a vector (D,)."""
    return (x - x.mean()) / (x.var(unbiased=False) + 1e-6).sqrt() * norm.weight + norm.bias


def written(
    mechanism: FastWeights, weights: list[tuple[Tensor, Tensor]], frame: Tensor, step: int
) -> tuple[list[tuple[Tensor, Tensor]], Tensor, list[float]]:
    """Return weights and biases of the heads after a frame (P, D), its outputs, and how long the steps were."""
    encoded = mechanism.encoder(frame[None, None], torch.tensor([[step]]))[0, 0]
    rates = softplus(encoded @ mechanism.rate.weight.T + mechanism.rate.bias).clamp(max=MAX_RATE)
    after, outputs, lengths = [], [], []
    for head, (weight, bias) in enumerate(weights):
        part = slice(head * weight.shape[0], (head + 1) * weight.shape[0])
        queries, keys, values = (
            [normed(linear.weight[part] @ token, norm) for token in encoded]
            for linear, norm in (
                (mechanism.query, mechanism.query_norm),
                (mechanism.key, mechanism.key_norm),
                (mechanism.value, mechanism.value_norm),
            )
        )

        def rms(z: Tensor, head: int = head) -> Tensor:
            return z / (z.square().mean() + 1e-8).sqrt() * (1 + mechanism.scale[head, 0]) + mechanism.shift[head, 0]

        weight, bias = weight.detach().requires_grad_(), bias.detach().requires_grad_()
        loss = sum(
            rates[token, head].detach() * (rms(key @ weight + bias) - (value - key)).square().sum() / 2
            for token, (key, value) in enumerate(zip(keys, values, strict=True))
        )
        assert isinstance(loss, Tensor)
        moved = []
        for old, gradient in zip((weight, bias), torch.autograd.grad(loss, (weight, bias)), strict=True):
            lengths.append(float(gradient.norm()))
            moved.append((old - gradient * (MAX_STEP / max(MAX_STEP, lengths[-1]))).detach())
        after.append((moved[0], moved[1]))
        outputs.append(torch.stack([rms(query @ moved[0] + moved[1]) + query for query in queries]))
    joined = torch.stack([normed(token, mechanism.post_norm) for token in torch.cat(outputs, dim=1)])
    return after, encoded + joined @ mechanism.attended.weight.T, lengths


@pytest.mark.parametrize("std", [0.5, 1.5])
def test_weights_equal_their_formula(std: float) -> None:
    """Autograd computes the step on the inner loss here; with large weights steps are shortened."""
    mechanism, count = made(std), FRAMES_READ + 2
    frames, steps = torch.randn(count, 2, 3, 12, dtype=torch.float64), torch.arange(count) * 16
    with torch.no_grad():
        state = mechanism.init(2)
        for frame, step in zip(frames, steps, strict=True):
            state = mechanism.write(state, frame, step.repeat(2))
        read = mechanism.read(state)
    shortened = 0
    for row in range(2):
        weights = [(mechanism.weight[head], mechanism.bias[head, 0]) for head in range(HEADS)]
        outputs = []
        for frame, step in zip(frames[:, row], steps, strict=True):
            weights, output, lengths = written(mechanism, weights, frame, int(step))
            outputs.append(output)
            shortened += sum(length > MAX_STEP for length in lengths)
        for head, (weight, bias) in enumerate(weights):
            torch.testing.assert_close(state["weight"][row, head], weight, rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(state["bias"][row, head, 0], bias, rtol=1e-5, atol=1e-5)
        expected = mechanism.out(torch.cat(outputs[-FRAMES_READ:]))
        torch.testing.assert_close(read.each[row], expected, rtol=1e-5, atol=1e-5)
    assert read.steps is not None
    assert read.steps[0].tolist() == [16 * frame for frame in range(2, count) for _ in range(3)]
    assert (shortened > 0) == (std > 1)


def test_missing_frames_are_masked() -> None:
    mechanism = made()
    state = mechanism.write(mechanism.init(1), torch.randn(1, 3, 12, dtype=torch.float64), torch.tensor([0]))
    read = mechanism.read(state)
    assert read.mask.shape == (1, FRAMES_READ * 3)
    assert read.mask[0].nonzero().flatten().tolist() == [*range(FRAMES_READ * 3 - 3, FRAMES_READ * 3)]


def test_gradients_pass_through_the_weights() -> None:
    """A frame whose output is dropped still gets a gradient by the weights, up to ``gradient_frames``."""
    mechanism, count = made(gradient_frames=10), 13
    frames = torch.randn(count, 3, 12, dtype=torch.float64, requires_grad=True)
    histories = Histories(frames, torch.arange(count) * 16, torch.arange(count)[None])
    mechanism.replay(histories).each[:, -3:].square().sum().backward()  # of the last frame
    assert frames.grad is not None
    assert frames.grad.flatten(1).any(dim=1).tolist() == [False] * 3 + [True] * 10


def test_initial_rate() -> None:
    torch.manual_seed(0)
    mechanism = FastWeights(SPEC, torch.nn.Identity(), read_settings("fast_weights", {}))
    assert softplus(mechanism.rate.bias).tolist() == pytest.approx([BASE_RATE] * HEADS)
