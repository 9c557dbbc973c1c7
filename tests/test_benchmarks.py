"""The scripts in `benchmarks/`: they import, and run with their smallest arguments."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SMALLEST = {
    "dataset_writing": "--episodes 1 --repeats 1 --ways write",
    "gpu": "--size tiny --device cpu --steps 1 --out {folder}/gpu.jsonl",
    "memory_cost": "--memory none bank --steps 30 --repeats 1",
    "mujoco_renderers": "--frames 1 --backends egl",
    "object_update": "src --rounds 1 --memory frames",
    "step_with_objects": "--steps 5 --repeats 1 --tasks 1",
}
"""Script -> arguments."""


@pytest.mark.parametrize("name", SMALLEST)
def test_benchmark_imports(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    for module in ("turns", "policies", "random_weights", "object_update", name):
        monkeypatch.delitem(sys.modules, module, raising=False)
    importlib.import_module(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLEST)
def test_benchmark_runs(name: str, tmp_path: Path) -> None:
    arguments = SMALLEST[name].format(folder=tmp_path).split()
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), *arguments]
    done = subprocess.run(command, cwd=BENCHMARKS.parent, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert "error" not in done.stdout
    assert done.stdout
