"""Controls: found by their setting, refused in the wrong place, and shown in every report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.report import with_labels_of
from lerobot_memobench.evaluation.statistics import oracle_share
from tests.support.logs import rollout, write_log

STOVE = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it"
DRAWERS = "check_all_three_drawers_of_the_cabinet"
CONTROLS: dict[str, dict[str, Any]] = {
    "pause_steps": {"pause_steps": 100},
    "speed": {"speed": 0.5},
    "corrupt": {"corrupt": "delete", "reshow": True},
    "reshow": {"reshow": True},
    "interference": {"interference": 2},
    "oracle_memory": {"oracle_memory": True},
    "align_targets": {"policy_settings": {"align_targets": "shuffled"}},
}


def evaluation(
    folder: Path,
    reached: list[int],
    policy: str = "a",
    operations: str = "SUU",
    task: str = STOVE,
    policy_settings: dict[str, Any] | None = None,
    **settings: Any,
) -> str:
    """One rollout per number: that many of its checkpoints were satisfied; with protocol and card."""
    changes = settings | ({"paused_steps": 210} if "pause_steps" in settings else {})
    records = [
        rollout(task, "temporal", operations, [j < n for j in range(3)], n == 3, k, **changes)
        for k, n in enumerate(reached)
    ]
    facts = {"type": "memobench_mem", "sha256": policy, "settings": policy_settings or {}}
    return str(write_log(folder, records, **facts))


def rows_of(out: Path) -> dict[tuple[str, str], dict[str, Any]]:
    found = json.loads((out / "compare.json").read_text())
    return {(row["scope"], row["metric"]): row for row in found["differences"]}


@pytest.mark.parametrize("control", CONTROLS)
def test_a_control_is_found_by_its_setting_and_joins_reports(
    tmp_path: Path, control: str, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = evaluation(tmp_path / "plain", [3] * 8 + [1] * 2)
    other = evaluation(tmp_path / "other", [3] * 2 + [1] * 8, **CONTROLS[control])
    out = tmp_path / "out"
    assert main(["compare", plain, other, "--format", "json", "--format", "markdown", "--out", str(out)]) == 0
    assert json.loads((out / "compare.json").read_text())["control"] == control
    row = rows_of(out)[STOVE, "SR"]
    assert (row["a"], row["b"], row["difference"]) == (80, 20, -60)
    assert -95 < row["low"] < -60 < row["high"] < -10
    # A report of both shows the average and memory types, the page for the browser one line.
    words = ["report", plain, other, "--format", "json", "--out", str(out), "--html", str(tmp_path / "page")]
    assert main(words) == 0
    (found,) = json.loads((out / "report.json").read_text())["controls"]
    assert (found["control"], found["a"], found["b"]) == (control, "plain", "other")
    assert {row["kind"] for row in found["differences"]} == {"average", "memory type"}
    assert "SR −60.0 [" in (tmp_path / "page" / "index.html").read_text()
    assert main(["compare", other, plain]) == 2
    assert f"{control}=" in capsys.readouterr().err
    assert main(["report", other, "--format", "json", "--out", str(out)]) == 0
    assert "controls" not in json.loads((out / "report.json").read_text())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pause_steps": 50, "speed": 0.5}, "speed: 1.0 and 0.5"),
        ({"pause_steps": 50, "policy": "b"}, "of two policies"),
        ({"corrupt": "swap", "interference": 1}, "interference: 0 and 1"),
    ],
)
def test_a_control_differs_in_nothing_else(
    tmp_path: Path, settings: dict[str, Any], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = evaluation(tmp_path / "a", [1]), evaluation(tmp_path / "b", [1], **settings)
    assert main(["compare", a, b]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert main(["report", a, b, "--format", "json"]) == 0
    assert "controls" not in json.loads(capsys.readouterr().out)


# --- oracle memory ---


@pytest.mark.parametrize(
    ("first", "second", "closed"),
    [(0.5, 0.75, 0.5), (0.0, 0.3, 0.3), (0.5, 0.25, -0.5), (1.0, 1.0, None), (0.996, 0.968, None), (None, 0.5, None)],
)
def test_share_of_the_gap(first: float | None, second: float, closed: float | None) -> None:
    assert oracle_share(first, second) == (None if closed is None else pytest.approx(closed))


def test_oracle_memory_closes_a_share_of_the_gap(tmp_path: Path) -> None:
    plain = evaluation(tmp_path / "plain", [1, 1, 0, 0])
    oracle = evaluation(tmp_path / "oracle", [3, 1, 1, 0], policy="b", oracle_memory=True)
    words = ["--format", "json", "--out", str(tmp_path)]
    assert main(["compare", plain, oracle, *words]) == 0
    found = rows_of(tmp_path)["temporal", "MSR"]
    assert (found["a"], found["b"], found["gap_closed"]) == (50, 75, 50)
    assert found["gap_closed_low"] < 50 < found["gap_closed_high"] <= 100


# --- shuffled memory ---


def test_shuffled_memory_is_compared_checkpoint_by_checkpoint(tmp_path: Path) -> None:
    """50 rollouts that come as far as the paper's give its curves: 76, 52, 8 and 90, 24, 2."""

    def reach(first: int, second: int, third: int) -> list[int]:
        return [3] * third + [2] * (second - third) + [1] * (first - second) + [0] * (50 - first)

    normal = evaluation(tmp_path / "normal", reach(38, 26, 4))
    shuffled = evaluation(tmp_path / "shuffled", reach(45, 12, 1), "b", policy_settings={"align_targets": "shuffled"})
    words = ["--format", "json", "--out", str(tmp_path)]
    assert main(["compare", normal, shuffled, *words]) == 0
    found = [rows_of(tmp_path)[STOVE, f"c{k}"] for k in (1, 2, 3)]
    assert [(row["a"], row["b"]) for row in found] == [(76, 90), (52, 24), (8, 2)]
    assert found[1]["high"] < 0


def test_a_checkpoint_after_a_missed_one_does_not_count(tmp_path: Path) -> None:
    normal = evaluation(tmp_path / "normal", [0])
    shuffled = evaluation(tmp_path / "shuffled", [3], "b", policy_settings={"align_targets": "shuffled"})
    write_log(tmp_path / "normal", [rollout(STOVE, "temporal", "SUU", [False, True, True], False, 0)])
    assert main(["compare", normal, shuffled, "--format", "json", "--out", str(tmp_path)]) == 0
    assert [rows_of(tmp_path)[STOVE, f"c{k}"]["a"] for k in (1, 2, 3)] == [0, 0, 0]


# --- granularity ---


def test_granularity_counts_each_level_by_its_own_labels(tmp_path: Path) -> None:
    words = []
    for level, reached in (("coarse", [3, 3, 0]), ("intermediate", [2, 2, 2]), ("fine", [2, 0, 0])):
        settings = {"subgoal_level": level}
        words.append(evaluation(tmp_path / level, reached, level, "SUC", DRAWERS, policy_settings=settings))
    out = ["--format", "json", "--out", str(tmp_path)]
    assert main(["report", *words, *out]) == 0
    found = json.loads((tmp_path / "report.json").read_text())
    own = {name: rates["own_labels"] for name, rates in found["granularity"].items()}
    # The third checkpoint is a Compression, but an Update in the labels of the fine level.
    assert own["coarse"] == {"SR": 66.7, "MSR": 66.7, "MUR": 66.7, "MCR": 66.7}
    assert own["intermediate"] == {"SR": 0.0, "MSR": 100.0, "MUR": 100.0, "MCR": 0.0}
    assert own["fine"] == {"SR": 0.0, "MSR": 33.3, "MUR": 16.7, "MCR": None}
    assert found["evaluations"]["fine"]["average"]["MUR"] == 33.3
    assert main(["report", *words[:1], *out]) == 0
    assert "granularity" not in json.loads((tmp_path / "report.json").read_text())


def test_labels_of_another_version_of_a_task_are_refused() -> None:
    three, two = (rollout(DRAWERS, "temporal", "SUC"[:n], [True] * n, False, 0) for n in (3, 2))
    own = rollout("a_task_of_mine", "temporal", "SC", [True, True], True, 0)
    changed, kept = with_labels_of("fine", [three, own])
    assert [checkpoint["operation"] for checkpoint in changed["checkpoints"]] == ["S", "U", "U"]
    assert kept == own
    with pytest.raises(MemobenchError, match="another version of the task"):
        with_labels_of("fine", [two])
