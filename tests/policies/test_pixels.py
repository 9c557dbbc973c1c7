"""Seeing pictures: pooled tokens are what they were when caches were made, and the prefix is LeRobot's."""

from __future__ import annotations

import pytest
import torch
from lerobot.policies.pi05.modeling_pi05 import PaliGemmaWithExpertModel

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import pool_tokens
from lerobot_memobench.policies.memobench_mem.network import SizedPaliGemmaWithExpert


def test_pooling_is_the_mean_of_blocks() -> None:
    tokens = torch.randn(2, 256, 3)
    pooled = pool_tokens(tokens)
    grid = tokens.reshape(2, 16, 16, 3)
    torch.testing.assert_close(pooled[1, 4 * 1 + 2], grid[1, 4:8, 8:12].mean(dim=(0, 1)))
    with pytest.raises(ValueError, match="pool"):
        pool_tokens(torch.randn(1, 36, 3))


def test_pooling_is_bit_for_bit_the_one_that_caches_were_made_with() -> None:
    tokens = torch.randn(5, 64, 7, generator=torch.Generator().manual_seed(0))
    expected = tokens.reshape(5, 4, 2, 4, 2, 7).mean(dim=(2, 4)).reshape(5, 16, 7)
    assert torch.equal(pool_tokens(tokens), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_prefix_is_lerobots(dtype: torch.dtype) -> None:
    pair = SizedPaliGemmaWithExpert(MemobenchMemConfig(device="cpu"))
    pictures = (torch.rand(2, 3, 96, 96, generator=torch.Generator().manual_seed(0)) * 2 - 1).to(dtype)
    with torch.no_grad():
        assert torch.equal(pair.embed_image(pictures), PaliGemmaWithExpertModel.embed_image(pair, pictures))
