"""The pure parts of the memory: choice of frames, positions, pooling, modulation, and the history of a rollout."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.policies.memobench_mem.memory import (
    MemoryEncoder,
    MemoryModulator,
    RolloutMemory,
    pool_tokens,
    position_features,
    sample_frames,
)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 3000), st.integers(2, 64))
def test_sampled_frames_are_even_increasing_and_reach_both_ends(step: int, frames: int) -> None:
    chosen = sample_frames(step, frames)
    assert len(chosen) == min(step + 1, frames)
    assert chosen[0] == 0
    assert chosen[-1] == step
    gaps = np.diff(chosen)
    if len(gaps):
        assert gaps.min() >= 1
        assert gaps.max() - gaps.min() <= 1


def test_all_frames_are_kept_while_they_fit() -> None:
    assert sample_frames(31, 32) == list(range(32))
    assert sample_frames(32, 32)[:3] == [0, 1, 2]
    assert len(sample_frames(32, 32)) == 32
    assert sample_frames(62, 32) == list(range(0, 63, 2))
    with pytest.raises(ValueError, match="step"):
        sample_frames(-1, 32)


def test_position_features_follow_the_stated_order() -> None:
    features = position_features(torch.tensor([[0, 7]])).numpy()
    assert features.shape == (1, 2, 16, 768)
    k = np.arange(128) / 127
    token = 4 * 2 + 3  # row 2, column 3 of the 4x4 grid
    t, y, x = 7.0, 4 * 2 + 2, 4 * 3 + 2
    expected = np.concatenate(
        [
            wave(value / base**k)
            for value, base in ((t, 10_000.0), (y, 1_000.0), (x, 1_000.0))
            for wave in (np.sin, np.cos)
        ]
    )
    np.testing.assert_allclose(features[0, 1, token], expected, atol=2e-5)
    assert not np.allclose(features[0, 0], features[0, 1])


def test_pooling_is_the_mean_of_blocks() -> None:
    tokens = torch.randn(2, 256, 3)
    pooled = pool_tokens(tokens)
    grid = tokens.reshape(2, 16, 16, 3)
    torch.testing.assert_close(pooled[1, 4 * 1 + 2], grid[1, 4:8, 8:12].mean(dim=(0, 1)))
    with pytest.raises(ValueError, match="pool"):
        pool_tokens(torch.randn(1, 36, 3))


def test_encoder_shapes_and_mask() -> None:
    encoder = MemoryEncoder(image_dim=6, memory_dim=10)
    mask = torch.tensor([[True, True, False]])
    memory, token_mask = encoder(torch.randn(1, 3, 16, 6), torch.tensor([[0, 1, 0]]), mask)
    assert memory.shape == (1, 48, 10)
    assert token_mask.tolist() == [[True] * 32 + [False] * 16]


def test_encoder_equals_its_formula_token_by_token() -> None:
    """concat(image, SiLU(Linear(position))) -> Linear, although the code never builds the concatenations."""
    encoder = MemoryEncoder(image_dim=6, memory_dim=10)
    tokens, steps = torch.randn(2, 3, 16, 6), torch.tensor([[0, 4, 9], [100, 700, 1199]])
    memory, _ = encoder(tokens, steps, torch.ones(2, 3, dtype=torch.bool))
    position = torch.nn.functional.silu(encoder.position(position_features(steps)))
    expected = encoder.project(torch.cat([tokens, position], dim=-1)).flatten(1, 2)
    torch.testing.assert_close(memory, expected, rtol=1e-5, atol=1e-5)


def _modulator() -> MemoryModulator:
    torch.manual_seed(0)
    modulator = MemoryModulator(32)
    torch.nn.init.normal_(modulator.modulation.weight, std=0.1)
    return modulator


def test_modulator_starts_at_zero() -> None:
    scale, shift = MemoryModulator(32)(torch.randn(2, 5, 32), torch.randn(2, 7, 32), torch.ones(2, 7, dtype=torch.bool))
    assert not scale.any()
    assert not shift.any()


def test_modulator_sees_only_unmasked_memory() -> None:
    modulator, actions, memory = _modulator(), torch.randn(1, 5, 32), torch.randn(1, 6, 32)
    mask = torch.tensor([[True, True, True, True, False, False]])
    changed = memory.clone()
    changed[:, 4:] = 1e4
    for a, b in zip(modulator(actions, memory, mask), modulator(actions, changed, mask), strict=True):
        torch.testing.assert_close(a, b)
    all_seen = modulator(actions, memory, torch.ones_like(mask))
    assert not torch.allclose(all_seen[0], modulator(actions, memory, mask)[0])


def test_all_masked_memory_is_finite_and_reads_zero() -> None:
    modulator, actions = _modulator(), torch.randn(2, 5, 32, requires_grad=True)
    memory = torch.randn(2, 6, 32, requires_grad=True)
    mask = torch.zeros(2, 6, dtype=torch.bool)
    mask[1] = True
    scale, shift = modulator(actions, memory, mask)
    assert not scale[0].any()
    assert not shift[0].any()
    assert scale[1].abs().sum() > 0
    (scale.sum() + shift.sum()).backward()
    assert memory.grad is not None
    assert torch.isfinite(memory.grad).all()
    assert not memory.grad[0].any()


def test_positions_matter_to_the_modulator() -> None:
    modulator, actions, memory = _modulator(), torch.randn(1, 5, 32), torch.randn(1, 6, 32)
    mask = torch.ones(1, 6, dtype=torch.bool)
    assert not torch.allclose(modulator(actions, memory, mask)[0], modulator(actions, memory.flip(1), mask)[0])


def _encode(values: list[float]):  # type: ignore[no-untyped-def]
    return lambda rows: torch.stack([torch.full((16, 2), values[row]) for row in rows])


def test_rows_start_freeze_and_stay_apart() -> None:
    memory = RolloutMemory(frames=4, stride=1)
    assert memory.observe([0, 0], _encode([1.0, 2.0])) == ([True, True], [False, False])
    assert memory.observe([1, 0], _encode([3.0, 99.0])) == ([False, False], [False, True])  # row 1 frozen
    assert memory.observe([2, 1], _encode([5.0, 4.0])) == ([False, False], [False, False])
    assert memory.observe([0, 2], _encode([7.0, 6.0])) == ([True, False], [False, False])  # row 0 begins again
    tokens, steps, mask = memory.gather([0, 1])
    assert steps.tolist() == [[0, 0, 0, 0], [0, 1, 2, 0]]
    assert mask.tolist() == [[True, False, False, False], [True, True, True, False]]
    assert tokens[0, 0, 0, 0] == 7
    assert [float(t[0, 0]) for t in tokens[1]] == [2, 4, 6, 0]
    alone, _, _ = memory.gather([1])
    assert torch.equal(alone[0], tokens[1])


def test_stride_and_sampling_of_a_long_history() -> None:
    memory = RolloutMemory(frames=4, stride=3)
    for step in range(20):
        memory.observe([step], _encode([float(step)]))
    tokens, steps, mask = memory.gather([0])
    assert steps.tolist() == [[0, 6, 12, 18]]
    assert mask.all()
    assert [float(t[0, 0]) for t in tokens[0]] == [0, 6, 12, 18]
    memory.reset()
    assert memory.rows == []


def test_keys_are_computed_once_per_memory_and_only_without_gradients() -> None:
    from lerobot_memobench.policies.memobench_mem.memory import MemoryState, ModulatedNorm

    class Plain(torch.nn.Module):
        def forward(self, x: torch.Tensor, cond: torch.Tensor | None = None) -> tuple[torch.Tensor, None]:
            return x, None

    modulator, state = _modulator(), MemoryState()
    norm = ModulatedNorm(Plain(), modulator, state)
    calls: list[int] = []
    keys = modulator.keys
    modulator.keys = lambda memory: calls.append(1) or keys(memory)  # type: ignore[method-assign]
    actions, mask = torch.randn(2, 5, 32), torch.ones(2, 9, dtype=torch.bool)
    memories = torch.randn(3, 2, 9, 32)
    fresh = []
    for memory in memories:
        state.set(memory, mask)
        fresh.append(norm(actions)[0].detach())
        norm(actions)
    assert len(calls) == 6  # with gradients: every time, as checkpointing runs layers again
    with torch.no_grad():
        for memory, expected in zip(memories, fresh, strict=True):
            state.set(memory, mask)
            for _ in range(3):
                torch.testing.assert_close(norm(actions)[0], expected)
    assert len(calls) == 9
