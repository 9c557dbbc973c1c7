"""Functions compile without a usable cache, too, and no operations are fused."""

from __future__ import annotations

import pickle
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import caching, config

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


def test_cache_of_a_version_with_other_modules_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    assert compiled(fused)(1.0, 2.0, 3.0) == 5.0
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(pickle.dumps(numba.__version__) + b"cno_such_module\nParameters\n.")
    assert compiled(fused)(1.0, 2.0, 3.0) == 5.0
    assert b"no_such_module" not in index.read_bytes()
