"""Pauses and slower actions against logs made by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.evaluation.html.data import facts
from lerobot_memobench.evaluation.pacing_controls import kept_changes, paced_changes
from lerobot_memobench.evaluation.records import read_runs
from tests.support.logs import SETTINGS, rollout

STOVE = "turn_on_the_stove_and_turn_it_off"
TOMATO = "put_the_tomato_into_the_top_drawer_of_the_cabinet"


def evaluation(folder: Path, stove: int, tomato: int, policy: str = "act", **settings: Any) -> str:
    """An evaluation of ten episodes of two tasks, of which so many succeed."""
    told = {} if "pause_steps" not in settings else {"paused_steps": 210}
    records = [
        rollout(task, memory_type, operations, [True, k < good], k < good, k, **told)
        for task, memory_type, operations, good in ((STOVE, "temporal", "SC", stove), (TOMATO, "spatial", "SU", tomato))
        for k in range(10)
    ]
    write_episodes(folder, records)
    protocol = {**SETTINGS, **settings, "policy": {"type": policy, "sha256": policy}}
    (folder / "protocol.json").write_text(json.dumps(protocol))
    return str(folder)


def test_a_drop_is_told_by_operation_family_and_task_with_its_interval(tmp_path: Path) -> None:
    plain = evaluation(tmp_path / "plain", 8, 9)
    paused = evaluation(tmp_path / "paused", 2, 9, pause_steps=100)
    (found,), _ = paced_changes("pause_steps", Path(plain), Path(paused))
    assert (found["setting"], found["value"], found["pairs"], found["paused_steps"]) == ("pause_steps", 100, 20, 210)
    assert (change := found["families"]["stove_transition"]["SR"]) == found["tasks"][STOVE]["SR"]
    assert change is not None
    assert (change["plain"], change["paced"], change["change"]) == (80.0, 20.0, -60.0)
    assert -95 < change["low"] < -60 < change["high"] < -10
    assert found["memory_types"]["temporal"]["MSR"] == {**change, "plain": 100, "paced": 100, "change": 0} | {
        "low": pytest.approx(-27.8, abs=0.2),
        "high": pytest.approx(27.8, abs=0.2),
    }
    assert found["tasks"][TOMATO]["MCR"] is None
    assert found["average"]["SR"] == pytest.approx(
        {"plain": 85, "paced": 55, "change": -30, "low": -50, "high": -10}, abs=8
    )


def test_the_commands_join_the_report_of_the_paced_evaluation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = evaluation(tmp_path / "plain", 8, 9)
    slow = evaluation(tmp_path / "slow", 8, 3, speed=0.5)
    assert main(["controls", "speed", plain, slow, "--out", str(tmp_path / "out")]) == 0
    assert "speed=0.5, replan interval 5" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / "speed.json").read_text())["changes"] == kept_changes(tmp_path / "slow")
    (kept,) = json.loads((tmp_path / "slow" / "report.json").read_text())["pacing"]
    assert kept["average"]["SR"]["change"] == -30.0
    assert "Slower actions" in (tmp_path / "slow" / "report.md").read_text()
    assert "pacing" not in json.loads((tmp_path / "slow" / ".." / "out" / "speed.json").read_text())
    (run,) = read_runs([slow])
    assert any(fact.startswith("speed=0.5: SR -30.0 [") for fact in facts(run))
    assert main(["report", plain, slow]) == 0
    assert "Slower actions" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("plain", "paced", "said"),
    [
        ({"pause_steps": 50}, {}, "expected first the evaluation without (the default, 0), then the one with"),
        ({}, {}, "pause_steps=0 and"),
        ({}, {"pause_steps": 50, "speed": 0.5}, "speed: 1.0 and 0.5"),
        ({}, {"pause_steps": 50, "horizon": 600}, "horizon: 1200 and 600"),
        ({}, {"pause_steps": 50, "policy": "pi05"}, "are of two policies"),
    ],
)
def test_what_does_not_pair_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plain: dict[str, Any], paced: dict[str, Any], said: str
) -> None:
    a, b = evaluation(tmp_path / "a", 1, 1, **plain), evaluation(tmp_path / "b", 1, 1, **paced)
    assert main(["controls", "pauses", a, b]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "b" / "pacing.json").exists()


def test_a_strange_file_beside_the_log_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = evaluation(tmp_path / "a", 1, 1)
    (tmp_path / "a" / "pacing.json").write_text('[{"setting": "horizon"}]')
    assert main(["report", folder]) == 2
    assert "pacing.json" in capsys.readouterr().err


def test_a_file_of_which_figures_are_missing_is_shown_as_far_as_it_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = evaluation(tmp_path / "a", 1, 1, speed=0.5)
    nothing: dict[str, Any] = {"average": {}, "memory_types": {}, "families": {}, "tasks": {}}
    told = [{"setting": "speed", "value": 0.5, "replan_steps": None, "pairs": 0, **nothing}]
    (tmp_path / "a" / "pacing.json").write_text(json.dumps(told))
    assert main(["report", folder]) == 0
    assert "speed=0.5, replan interval unknown" in capsys.readouterr().out
