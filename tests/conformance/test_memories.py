"""Every memory mechanism conforms, ours and that of the example, which is installed as anybody's package."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.conformance.checks import Outcome, run_checks
from lerobot_memobench.conformance.subject import load_subject
from lerobot_memobench.policies.memobench_mem.memory import OURS, mechanism_names


@pytest.mark.parametrize("memory", [*(pytest.param(name, marks=pytest.mark.slow) for name in OURS), "traces"])
def test_it_conforms(memory: str, traces: None, objects: Path, tmp_path: Path) -> None:
    assert memory in mechanism_names()
    words = ["policy=memobench_mem", f"policy.memory={memory}", "size=tiny", "policy.perception=objects"]
    results = run_checks(load_subject([*words, f"dataset={objects}"], tmp_path))
    assert {result.outcome for result in results} == {Outcome.PASSED}, results
