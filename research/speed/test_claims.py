"""The benchmarks by name. What they measure is not a test: machines differ."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from research.speed import claims


def test_unknown_benchmark() -> None:
    with pytest.raises(MemobenchError, match="there is no benchmark 'rest'; did you mean 'reset'"):
        list(claims.measure(["rest"]))


@pytest.mark.slow
def test_step_beside_robosuite(gl: str) -> None:
    result = claims.step_with_images(rounds=1)
    assert result.ratio == pytest.approx(result.theirs / result.ours, rel=0.01)
