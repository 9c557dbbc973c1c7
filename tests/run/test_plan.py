"""A plan: complete, typed, and what LeRobot is called with by it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from lerobot_memobench.run.arguments import LerobotSettings
from lerobot_memobench.run.plan import EvaluationPlan, Orders


def evaluation(*flags: str) -> EvaluationPlan:
    settings = LerobotSettings(flags)
    return EvaluationPlan(settings, None, None, None, Path("out"), Path("log"), 7, 1, Orders(), ("lerobot", "eval"))


def test_flags_are_complete_but_for_what_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("checkpoint").mkdir()
    asked = evaluation("--policy.path=checkpoint", "--seed", "7", "--env.videos=-1")
    assert asked.portable_flags == ["--seed=7", "--env.videos=-1", f"--policy.path={tmp_path / 'checkpoint'}"]
    assert evaluation("--policy.path=user/name").portable_flags == ["--policy.path=user/name"]  # a repository stays one
    given = ["--policy.path=checkpoint", "--seed", "7", "--env.videos=-1"]
    assert asked.lerobot_flags == [*given, "--output_dir=out", "--env.log_dir=log"]


def test_a_plan_never_changes() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        evaluation().output = Path("elsewhere")  # type: ignore[misc]
