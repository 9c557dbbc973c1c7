"""Memory tokens: positions, shapes, and the formula that the encoder never writes out."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lerobot_memobench.policies.memobench_mem.memory.encoder import MemoryEncoder, position_features


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


def test_encoder_shapes_and_mask() -> None:
    encoder = MemoryEncoder(image_dim=6, memory_dim=10)
    mask = torch.tensor([[True, True, False]])
    memory, token_mask = encoder(torch.randn(1, 3, 16, 6), torch.tensor([[0, 1, 0]]), mask)
    assert memory.shape == (1, 48, 10)
    assert token_mask.tolist() == [[True] * 32 + [False] * 16]


@pytest.mark.parametrize(
    "steps", [[[9, 4, 700], [4, 9, 1199]], [[9], [4], [700], [4], [9]]], ids=["rows", "one by one"]
)
def test_encoder_equals_its_formula_token_by_token(steps: list[list[int]]) -> None:
    """concat(image, SiLU(Linear(position))) -> Linear, although the code never builds the concatenations."""
    encoder, seen = MemoryEncoder(image_dim=6, memory_dim=10), torch.tensor(steps)
    tokens = torch.randn(*seen.shape, 16, 6)
    memory, _ = encoder(tokens, seen, torch.ones_like(seen, dtype=torch.bool))
    position = torch.nn.functional.silu(encoder.position(position_features(seen)))
    expected = encoder.project(torch.cat([tokens, position], dim=-1)).flatten(1, 2)
    torch.testing.assert_close(memory, expected, rtol=1e-5, atol=1e-5)
    weights = [*encoder.parameters()]
    for made, by_formula in zip(
        *(torch.autograd.grad(of.square().sum(), weights) for of in (memory, expected)), strict=True
    ):
        torch.testing.assert_close(made, by_formula, rtol=1e-4, atol=1e-4)
