"""How evaluations are named and grouped to methods."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_memobench.cli.report import given_runs
from lerobot_memobench.envs.episode_log import write_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.html import write_html
from lerobot_memobench.evaluation.documents.report import build, render, write_report
from lerobot_memobench.evaluation.records.runs import by_method, read_rollouts, read_runs, sweeps
from tests.support import logs


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


def test_policies_that_nobody_knows_are_not_one_method(tmp_path: Path) -> None:
    for k in (5, 20):
        logs.evaluation(tmp_path / f"k{k}", replan_steps=k)
    assert [run.method for run in read_runs([tmp_path / "k5", tmp_path / "k20"])] == ["k5", "k20"]


def test_rollouts_beyond_those_asked_for_are_not_counted(tmp_path: Path) -> None:
    """LeRobot runs whole batches; earlier versions logged what its last one held beyond."""
    folder = logs.evaluation(tmp_path / "a")
    told = {"protocol": {"tasks": ["one", "two_of_them"], "episodes": 3, "seed_base": 7}, "policy": {"seed": 7}}
    (folder / "card.json").write_text(json.dumps(told))
    (run,) = read_runs([folder])
    assert [row["SR"].n for row in run.summary.tasks.values()] == [3, 3]
    assert run.notes == ["2 rollouts beyond the 3 of each task that were asked for left out"]
    assert write_report(folder)[0].tasks["one"]["SR"].n == 3
    assert read_rollouts(folder)[1] == [], "and now they are gone"
    (folder / "card.json").write_text(json.dumps({**told, "policy": {"seed": 9}}))
    logs.evaluation(folder)
    assert len(read_rollouts(folder)[0]) == 8, "episodes 2, 3 and 4 were asked for"


def test_evaluations_that_were_not_run_alike_are_shown_with_a_notice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = {"horizon": 1200, "referent": "fixed", "inputs": "pixels"}
    for name, changes in (("a", {}), ("b", {"horizon": 600, "inputs": "privileged object state"}), ("c", {})):
        folder = logs.evaluation(tmp_path / name, inputs={**settings, **changes}["inputs"])
        write_protocol(folder, {**settings, **changes})
    found = [f"{tmp_path}/{name}" for name in "abc"]
    words = "b was not run as a was (horizon: 1200 and 600; inputs: pixels and privileged object state"
    for name in ("markdown", "table", "latex", "json"):
        told = " ".join(render(build(read_runs(found)), read_runs(found), name).split())
        assert words in told.replace("\\_", "_"), name
        assert "c was not run" not in told, name
    assert words in (write_html(found, tmp_path / "page").page).read_text()
    assert '"notices":[]' in (write_html([found[0], found[2]], tmp_path / "page").page).read_text()
    given_runs(found, None)
    assert f"note: {words}" in capsys.readouterr().err


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
