"""How the action expert reads memory by modulation."""

from __future__ import annotations

import torch

from lerobot_memobench.policies.memobench_mem.fusion import (
    MemoryModulator,
    ModulatedNorm,
    SharedMemory,
)
from lerobot_memobench.policies.memobench_mem.memory.encoder import MemoryTokens


def _modulator() -> MemoryModulator:
    torch.manual_seed(0)
    modulator = MemoryModulator(32)
    torch.nn.init.normal_(modulator.modulation.weight, std=0.1)
    return modulator


def test_modulator_starts_at_zero() -> None:
    memory = MemoryTokens(torch.randn(2, 7, 32), torch.ones(2, 7, dtype=torch.bool))
    scale, shift = MemoryModulator(32)(torch.randn(2, 5, 32), memory)
    assert not scale.any()
    assert not shift.any()


def test_modulator_sees_only_unmasked_memory() -> None:
    modulator, actions, memory = _modulator(), torch.randn(1, 5, 32), torch.randn(1, 6, 32)
    mask = torch.tensor([[True, True, True, True, False, False]])
    changed = memory.clone()
    changed[:, 4:] = 1e4
    seen = modulator(actions, MemoryTokens(memory, mask))
    for a, b in zip(seen, modulator(actions, MemoryTokens(changed, mask)), strict=True):
        torch.testing.assert_close(a, b)
    all_seen = modulator(actions, MemoryTokens(memory, torch.ones_like(mask)))
    assert not torch.allclose(all_seen[0], seen[0])


def test_all_masked_memory_is_finite_and_reads_zero() -> None:
    modulator, actions = _modulator(), torch.randn(2, 5, 32, requires_grad=True)
    memory = torch.randn(2, 6, 32, requires_grad=True)
    mask = torch.zeros(2, 6, dtype=torch.bool)
    mask[1] = True
    scale, shift = modulator(actions, MemoryTokens(memory, mask))
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
    seen, flipped = (modulator(actions, MemoryTokens(tokens, mask))[0] for tokens in (memory, memory.flip(1)))
    assert not torch.allclose(seen, flipped)


def test_keys_are_computed_once_per_memory_and_only_without_gradients() -> None:
    class Plain(torch.nn.Module):
        def forward(self, x: torch.Tensor, cond: torch.Tensor | None = None) -> tuple[torch.Tensor, None]:
            return x, None

    modulator, state = _modulator(), SharedMemory()
    norm = ModulatedNorm(Plain(), modulator, state)
    calls: list[int] = []
    keys = modulator.keys
    modulator.keys = lambda memory: calls.append(1) or keys(memory)  # type: ignore[method-assign]
    actions, mask = torch.randn(2, 5, 32), torch.ones(2, 9, dtype=torch.bool)
    memories = torch.randn(3, 2, 9, 32)
    fresh = []
    for memory in memories:
        state.set(MemoryTokens(memory, mask))
        fresh.append(norm(actions)[0].detach())
        norm(actions)
    assert len(calls) == 6  # with gradients: every time, as checkpointing runs layers again
    with torch.no_grad():
        for memory, expected in zip(memories, fresh, strict=True):
            state.set(MemoryTokens(memory, mask))
            for _ in range(3):
                torch.testing.assert_close(norm(actions)[0], expected)
    assert len(calls) == 9


def test_memory_that_rows_share_is_read_as_their_own() -> None:
    """What is read, and every gradient."""
    modulator, actions = _modulator(), torch.randn(3, 5, 32)
    frames, places = torch.randn(4, 2, 32), torch.tensor([[0, 1, 2], [1, 2, 3], [3, 3, 0]])
    mask = torch.ones(3, 6, dtype=torch.bool)
    mask[2, 4:] = False
    found = []
    for share in (True, False):
        each = frames.clone().requires_grad_()
        memory = MemoryTokens(each, mask, places)
        read = modulator(actions, memory if share else MemoryTokens(memory.rows(), mask))
        wanted = [each, *(weight for name, weight in modulator.named_parameters() if "action" not in name)]
        found.append((*read, *torch.autograd.grad(read[0].square().sum() + read[1].sum(), wanted)))
    for ours, theirs in zip(*found, strict=True):
        assert theirs.abs().max() > 0
        torch.testing.assert_close(ours, theirs)
