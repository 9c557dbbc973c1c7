"""The benchmarks by name. Their times are not tested: machines differ."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from research.speed import claims, sides


def test_unknown_benchmark() -> None:
    with pytest.raises(MemobenchError, match="there is no benchmark 'rest'; did you mean 'reset'"):
        list(claims.measure(["rest"]))


def test_stock_robosuite_needs_an_earlier_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sides, "FULLM_READS_DATA", True)
    with pytest.raises(MemobenchError, match=r"need MuJoCo before 3\.10"):
        sides.stock_robosuite()


@pytest.mark.slow
@pytest.mark.skipif(sides.FULLM_READS_DATA, reason="robosuite's controllers do not run on MuJoCo 3.10 or later")
def test_step_beside_robosuite(gl: str) -> None:
    result = claims.step_with_images(rounds=1)
    assert result.ratio == pytest.approx(result.theirs / result.ours, rel=0.01)
