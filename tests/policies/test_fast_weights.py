"""Fast weights and recurrence: their formulas, written as loops, and the reach of gradients."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import softplus

from lerobot_memobench.policies.memobench_mem.memory import mechanism_settings, recurrent
from lerobot_memobench.policies.memobench_mem.memory.fast_weights import (
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
    mechanism = FastWeights(SPEC, torch.nn.Identity(), mechanism_settings("fast_weights", changed)).double()
    for name, weight in mechanism.named_parameters():
        if name != "rate.bias":
            torch.nn.init.normal_(weight, std=std)
    return mechanism


def normed(x: Tensor, norm: torch.nn.LayerNorm) -> Tensor:
    return (x - x.mean()) / (x.var(unbiased=False) + 1e-6).sqrt() * norm.weight + norm.bias


def written(
    mechanism: FastWeights, weights: list[tuple[Tensor, Tensor]], frame: Tensor, step: int
) -> tuple[list[tuple[Tensor, Tensor]], Tensor, list[float]]:
    """Return weights and biases of the heads after a frame (P, D), its outputs, and how long the steps were."""
    encoded = mechanism.encoder(frame[None], torch.tensor([step]))[0]
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
    assert read.steps[0].tolist() == [16 * frame for frame in range(2, count) for _ in range(3)]
    assert (shortened > 0) == (std > 1)


def test_gradients_pass_through_the_weights() -> None:
    """A frame whose output is dropped still gets a gradient by the weights, up to ``gradient_frames``."""
    mechanism, count = made(gradient_frames=10), 13
    frames = torch.randn(count, 3, 12, dtype=torch.float64, requires_grad=True)
    histories = Histories(frames, torch.arange(count) * 16, torch.arange(count)[None])
    mechanism.replay(histories).each[:, -3:].square().sum().backward()  # of the last frame
    assert frames.grad is not None
    assert frames.grad.flatten(1).any(dim=1).tolist() == [False] * 3 + [True] * 10


# -- recurrence ----------------------------------------------------------------------------------------------------

RECURRENT_SPEC = MemorySpec(dim=32, tokens=3, width=32, expert=16, grid=0, stride=16)


def made_recurrent(**changed: Any) -> recurrent.Recurrent:
    torch.manual_seed(0)
    mechanism = recurrent.Recurrent(
        RECURRENT_SPEC, torch.nn.Identity(), mechanism_settings("recurrent", changed)
    ).double()
    for weight in mechanism.parameters():
        torch.nn.init.normal_(weight, std=0.5)
    return mechanism


def turned(x: Tensor, place: int) -> Tensor:
    """Return a vector (d,) rotated to its place, pair by pair."""
    half, out = len(x) // 2, torch.empty_like(x)
    for pair in range(half):
        angle = place * 10_000.0 ** (-pair / half)
        first, second = x[pair], x[half + pair]
        out[pair] = first * math.cos(angle) - second * math.sin(angle)
        out[half + pair] = second * math.cos(angle) + first * math.sin(angle)
    return out


def slots_after(mechanism: recurrent.Recurrent, slots: list[Tensor], frame: Tensor, step: int) -> list[Tensor]:
    """Return the slots after a frame (P, D), by the formula, a slot and a head at a time."""
    encoded = mechanism.encoder(frame[None], torch.tensor([step]))[0]
    both = [normed(token, mechanism.pre_norm) for token in [*encoded, *slots]]
    of_key, of_value = mechanism.key_value.weight.chunk(2)
    keys = [turned(of_key @ token, place) for place, token in enumerate(both)]
    values = [of_value @ token for token in both]
    after = []
    for number, slot in enumerate(slots):
        place = len(encoded) + number
        heads = []
        for query in (mechanism.query.weight @ both[place]).chunk(recurrent.HEADS):
            scores = torch.stack([turned(query, place) @ key for key in keys]) / math.sqrt(len(query))
            heads.append(sum(weight * value for weight, value in zip(scores.softmax(0), values, strict=True)))
        after.append(normed(mechanism.attended.weight @ torch.cat(heads) + slot, mechanism.post_norm))
    return after


@torch.no_grad()
def test_slots_equal_their_formula() -> None:
    mechanism, frames = made_recurrent(), torch.randn(4, 2, 3, 32, dtype=torch.float64)
    state, steps = mechanism.init(2), torch.tensor([[0, 16, 32, 48], [8, 24, 40, 56]])
    for number, frame in enumerate(frames):
        state = mechanism.write(state, frame, steps[:, number])
    read = mechanism.read(state)
    for row in range(2):
        slots = [*mechanism.initial]
        for number, frame in enumerate(frames[:, row]):
            slots = slots_after(mechanism, slots, frame, int(steps[row, number]))
        expected = torch.stack([mechanism.out.weight @ slot + mechanism.out.bias for slot in slots])
        torch.testing.assert_close(read.each[row], expected, rtol=1e-6, atol=1e-6)  # angles are float32
    assert read.mask.all()
