"""Recurrence: its formula, row by row and head by head, and the reach of gradients."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory import read_settings
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories, MemorySpec
from lerobot_memobench.policies.memobench_mem.memory.recurrent import HEADS, Recurrent

SPEC = MemorySpec(dim=32, tokens=3, width=32, expert=16, grid=0, stride=16)


def made(**changed: Any) -> Recurrent:
    """Build a mechanism in float64 with large weights."""
    torch.manual_seed(0)
    mechanism = Recurrent(SPEC, torch.nn.Identity(), read_settings("recurrent", changed)).double()
    for weight in mechanism.parameters():
        torch.nn.init.normal_(weight, std=0.5)
    return mechanism


def normed(x: Tensor, norm: torch.nn.LayerNorm) -> Tensor:
    """Return the layer norm of a vector (D,)."""
    return (x - x.mean()) / (x.var(unbiased=False) + 1e-6).sqrt() * norm.weight + norm.bias


def turned(x: Tensor, place: int) -> Tensor:
    """Return a vector (d,) rotated to its place, pair by pair."""
    half, out = len(x) // 2, torch.empty_like(x)
    for pair in range(half):
        angle = place * 10_000.0 ** (-pair / half)
        first, second = x[pair], x[half + pair]
        out[pair] = first * math.cos(angle) - second * math.sin(angle)
        out[half + pair] = second * math.cos(angle) + first * math.sin(angle)
    return out


def written(mechanism: Recurrent, slots: list[Tensor], frame: Tensor, step: int) -> list[Tensor]:
    """Return the slots after a frame (P, D), by the formula, a slot and a head at a time."""
    encoded = mechanism.encoder(frame[None, None], torch.tensor([[step]]))[0, 0]
    both = [normed(token, mechanism.pre_norm) for token in [*encoded, *slots]]
    of_key, of_value = mechanism.key_value.weight.chunk(2)
    keys = [turned(of_key @ token, place) for place, token in enumerate(both)]
    values = [of_value @ token for token in both]
    after = []
    for number, slot in enumerate(slots):
        place = len(encoded) + number
        heads = []
        for query in (mechanism.query.weight @ both[place]).chunk(HEADS):
            scores = torch.stack([turned(query, place) @ key for key in keys]) / math.sqrt(len(query))
            heads.append(sum(weight * value for weight, value in zip(scores.softmax(0), values, strict=True)))
        after.append(normed(mechanism.attended.weight @ torch.cat(heads) + slot, mechanism.post_norm))
    return after


@torch.no_grad()
def test_slots_equal_their_formula() -> None:
    mechanism, frames = made(), torch.randn(4, 2, 3, 32, dtype=torch.float64)
    state, steps = mechanism.init(2), torch.tensor([[0, 16, 32, 48], [8, 24, 40, 56]])
    for number, frame in enumerate(frames):
        state = mechanism.write(state, frame, steps[:, number])
    read = mechanism.read(state)
    for row in range(2):
        slots = [*mechanism.initial]
        for number, frame in enumerate(frames[:, row]):
            slots = written(mechanism, slots, frame, int(steps[row, number]))
        expected = torch.stack([mechanism.out.weight @ slot + mechanism.out.bias for slot in slots])
        torch.testing.assert_close(read.each[row], expected, rtol=1e-6, atol=1e-6)  # angles are float32
    assert read.mask.all()


@pytest.mark.parametrize("reach", [1, 5])
def test_gradients_reach_the_last_frames(reach: int) -> None:
    mechanism = made(gradient_frames=reach)
    frames = torch.randn(9, 3, 32, dtype=torch.float64, requires_grad=True)
    places = torch.arange(9)[None]
    mechanism.replay(Histories(frames, torch.arange(9) * 16, places)).each.square().sum().backward()
    assert frames.grad is not None
    assert (frames.grad.flatten(1).any(dim=1)).tolist() == [False] * (9 - reach) + [True] * reach


def test_number_of_slots() -> None:
    assert made().initial.shape == (8, 32)
    assert made(slots=5).read(made(slots=5).init(3)).each.shape == (3, 5, 32)
