"""MemoryVLA's bank: its formulas token by token, merging of entries, and shares of entries."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity, gelu, layer_norm, rms_norm, silu

from lerobot_memobench.policies.memobench_mem.memory import mechanism_settings
from lerobot_memobench.policies.memobench_mem.memory.bank import Bank
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemorySpec, Query

D, P, STRIDE, LENGTH, FRAMES = 8, 2, 24, 3, 12


def made(**changed: Any) -> Bank:
    torch.manual_seed(0)
    spec = MemorySpec(dim=D, tokens=P, width=6, expert=6, grid=0, stride=STRIDE)
    return Bank(spec, torch.nn.Identity(), mechanism_settings("bank", {"length": LENGTH, **changed})).eval()


def written(bank: Bank, frames: Tensor, stride: int = STRIDE) -> Any:
    state = bank.init(1)
    for number, frame in enumerate(frames.split(1)):
        state = bank.write(state, frame, torch.tensor([number * stride]))
    return state


def attend(block: Any, asking: Tensor, keys: Tensor, values: Tensor) -> Tensor:
    """Post-norm cross-attention of tokens (N, d) to others (M, d), which are projected, by four heads; feed-forward."""
    query, key, value = (of(x) for of, x in ((block.query, asking), (block.key, keys), (block.value, values)))
    heads = [
        torch.softmax(q @ k.T / math.sqrt(q.shape[1]), dim=1) @ v
        for q, k, v in zip(query.chunk(4, 1), key.chunk(4, 1), value.chunk(4, 1), strict=True)
    ]
    asking = layer_norm(asking + torch.cat(heads, dim=1), asking.shape[1:])
    first, _, second = block.mlp
    return layer_norm(asking + second(gelu(first(asking))), asking.shape[1:])


def time_code(stream: Any, step: float) -> Tensor:
    angles = torch.tensor([step * 10_000 ** (-k / 128) for k in range(128)])
    code: Tensor = stream.time[2](silu(stream.time[0](torch.cat([angles.cos(), angles.sin()]))))
    return code


def fused(stream: Any, x: Tensor, entries: list[tuple[float, Tensor]], now: float) -> Tensor:
    entries = entries or [(now, x)]
    keys = torch.cat([entry + time_code(stream, step) for step, entry in entries])
    values, found = torch.cat([entry for _, entry in entries]), x
    for block in stream.blocks:
        found = attend(block, found, keys, values)
    gate = torch.sigmoid(stream.gate(torch.cat([x, found], dim=1)))
    return gate * x + (1 - gate) * found


def merged(entries: list[tuple[float, Tensor]]) -> list[tuple[float, Tensor]]:
    while len(entries) > LENGTH:
        alike = [cosine_similarity(a, b, dim=1).mean() for (_, a), (_, b) in itertools.pairwise(entries)]
        best = max(range(len(alike)), key=alike.__getitem__)
        (one_step, one), (other_step, other) = entries[best : best + 2]
        entries = [*entries[:best], ((one_step + other_step) / 2, (one + other) / 2), *entries[best + 2 :]]
    return entries


def literal(bank: Bank, frames: Tensor, present: Tensor) -> tuple[Tensor, dict[str, list[float]]]:
    """Return the memory tokens of a present (P, D) after frames (T, P, D), and the entries' steps."""

    def of(tokens: Tensor) -> dict[str, Tensor]:
        tokens = rms_norm(tokens, (D,), eps=1e-6)
        return {"perceptual": bank.reduce(tokens), "cognitive": attend(bank.summary, bank.asking[0], tokens, tokens)}

    entries: dict[str, list[tuple[float, Tensor]]] = {"perceptual": [], "cognitive": []}
    for number, frame in enumerate(frames):
        for name, x in of(frame).items():
            now = float(number * STRIDE)
            entries[name] = merged([*entries[name], (now, fused(bank.streams[name], x, entries[name], now))])
    read = [bank.out[name](fused(bank.streams[name], x, entries[name], 0.0)) for name, x in of(present).items()]
    return torch.cat(read), {name: [step for step, _ in kept] for name, kept in entries.items()}


@pytest.mark.parametrize("count", [1, 2, LENGTH, FRAMES])
def test_bank_equals_its_formula(count: int) -> None:
    bank = made()
    frames, present = torch.randn(count, P, D), torch.randn(1, P, D)
    with torch.no_grad():
        state = written(bank, frames)
        found = bank.read(state, Query(present)).rows()[0]
        expected, steps = literal(bank, frames, present[0])
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    kept = min(count, LENGTH)
    assert {name: state[f"{name}_steps"][0, :kept].tolist() for name in steps} == steps
    assert state["count"].tolist() == [kept]
    if count == FRAMES:
        assert steps["perceptual"] != steps["cognitive"], "streams merge independently"
