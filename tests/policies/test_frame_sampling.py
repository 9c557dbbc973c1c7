"""Which frames are sampled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.policies.memobench_mem.memory.frame_sampling import sample_frames


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
