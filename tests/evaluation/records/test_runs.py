"""How evaluations are named and grouped to methods."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.runs import by_method, read_runs, sweeps

from .. import logs


def card(folder: Path, **policy: object) -> None:
    told = {"protocol": {"tasks": [], "episodes": 4}, "policy": policy}
    (folder / "card.json").write_text(json.dumps(told))


def test_named_evaluations_are_one_method_at_several_intervals(tmp_path: Path) -> None:
    for k in (20, 5):
        logs.evaluation(tmp_path / f"k{k}", replan_steps=k)
    runs = read_runs([f"mine={tmp_path}/k20", f"mine={tmp_path}/k5"])
    assert [(run.name, run.method, run.replan_steps) for run in runs] == [
        ("mine k=20", "mine", 20),
        ("mine k=5", "mine", 5),
    ]
    assert [run.replan_steps for run in sweeps(runs)["mine"]] == [5, 20]


def test_unnamed_evaluations_are_grouped_by_policy(tmp_path: Path) -> None:
    for name, k, digest in (("a", 5, "aaaaaaaaaaaa"), ("b", 20, "aaaaaaaaaaaa"), ("c", 5, "cccccccccccc")):
        card(logs.evaluation(tmp_path / name, replan_steps=k), type="act", sha256=digest)
    runs = read_runs([tmp_path / "a", tmp_path / "b", tmp_path / "c"])
    assert {method: [run.name for run in group] for method, group in by_method(runs).items()} == {
        "act aaaaaaaa": ["a", "b"],
        "act cccccccc": ["c"],
    }


def test_the_policys_own_interval_is_known_from_its_card(tmp_path: Path) -> None:
    folder = logs.evaluation(tmp_path / "a", replan_steps=None)
    card(folder, type="act", settings={"n_action_steps": 35})
    assert read_runs([folder])[0].replan_steps == 35


def test_results_that_cannot_be_told_apart_are_named_after_folders(tmp_path: Path) -> None:
    for name in ("a", "b"):
        logs.evaluation(tmp_path / name)
    assert [run.method for run in read_runs([tmp_path / "a", tmp_path / "b"])] == ["a", "b"]
    with pytest.raises(MemobenchError, match="two evaluations named 'x'"):
        read_runs([f"x={tmp_path}/a", f"x={tmp_path}/b"])


def test_folders_of_the_same_name_get_longer_ones(tmp_path: Path) -> None:
    for name in ("a", "b"):
        logs.evaluation(tmp_path / name / "eval")
    assert [run.name for run in read_runs([tmp_path / "a" / "eval", tmp_path / "b" / "eval"])] == ["a/eval", "b/eval"]


def test_a_folder_may_hold_an_equals_sign(tmp_path: Path) -> None:
    (run,) = read_runs([str(logs.evaluation(tmp_path / "lr=3"))])
    assert run.name == "lr=3"


@pytest.mark.parametrize(
    ("words", "message"), [([], "no evaluation"), (["=x"], "NAME=FOLDER"), (["x="], "NAME=FOLDER")]
)
def test_what_is_no_evaluation(words: list[str], message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        read_runs(words)


def test_the_same_folder_twice(tmp_path: Path) -> None:
    folder = logs.evaluation(tmp_path / "a")
    with pytest.raises(MemobenchError, match="given twice"):
        read_runs([folder, folder])
