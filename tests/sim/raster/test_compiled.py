"""Functions compile without a cache folder, too, and no operations are fused."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core import caching

from lerobot_memobench.sim.raster.compiled import compiled


def fused(a: float, b: float, c: float) -> float:
    return a * b + c


@pytest.mark.parametrize("kept", [True, False])
def test_compiled_functions_round_every_operation(kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not kept:
        monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
    function = compiled(fused)
    a, b = np.float64(1 + 2**-30), np.float64(1 - 2**-30)
    assert function(a, b, np.float64(-1.0)) == 0.0  # -2**-60 where the product is not rounded
