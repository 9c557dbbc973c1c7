"""Evaluations read back: protocol, names, methods, notes; evaluations of two suites are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, line_of
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, write_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import compare_evaluations
from lerobot_memobench.evaluation.html import write_html
from lerobot_memobench.evaluation.records import headline, read_run, read_runs, sweeps
from lerobot_memobench.evaluation.report import evaluation_report, write_report
from lerobot_memobench.evaluation.tables import WRITERS
from lerobot_memobench.rollouts.shards import merge
from lerobot_memobench.tasks.catalogue import task_names
from tests.support import logs
from tests.support.logs import SETTINGS, evaluation, facts, write_log


def record(task: str = "a_task", episode: int = 0, **changes: Any) -> dict[str, Any]:
    return logs.record(task, episode, **{"replan_steps": 20} | changes)


# --- the protocol ---


def test_file_is_written_with_the_first_episode(tmp_path: Path) -> None:
    def log(**changes: Any) -> EpisodeLog:
        return EpisodeLog(tmp_path, facts({**SETTINGS, **changes}))

    first = log()
    assert not list(tmp_path.iterdir())
    first.append(line_of(record()))
    first.append(line_of(record("b", 3)))
    log().append(line_of(record(episode=1)))  # another worker
    assert read_run(tmp_path).protocol == {**SETTINGS, "tasks": ["a_task", "b"], "episodes": 4, "policy": {}}
    before = sorted((tmp_path / "episodes").iterdir()), (tmp_path / EVALUATION_FILE).read_bytes()
    with pytest.raises(MemobenchError, match="horizon: 1200 and 600"):
        log(horizon=600).append(line_of(record("other")))
    assert before == (sorted((tmp_path / "episodes").iterdir()), (tmp_path / EVALUATION_FILE).read_bytes())
    asked = {**SETTINGS, "tasks": ["a_task"], "episodes": 50}
    write_evaluation(tmp_path, facts(asked, {"type": "act"}))
    assert read_run(tmp_path).protocol == {**asked, "policy": {"type": "act"}}


def test_records_have_the_settings_of_their_file(tmp_path: Path) -> None:
    write_log(tmp_path, [record(suite="strict", replan_steps=20, inputs="pixels", policy="act 0123")])
    (line,) = (tmp_path / "episodes.jsonl").read_text().splitlines()
    assert not {*SETTINGS, "inputs", "policy"} & {*json.loads(line)}
    (found,) = read_run(tmp_path).records
    expected = {**SETTINGS, "suite": "strict", "replan_steps": 20, "inputs": "pixels", "policy": "act 0123"}
    assert found == {**json.loads(line), **expected}


# --- names and methods ---


def test_methods_are_names_policies_or_folders(tmp_path: Path) -> None:
    for name, k, digest in (("a", 5, "aaaaaaaaaaaa"), ("b", 20, "aaaaaaaaaaaa"), ("c", 5, "cccccccccccc")):
        logs.evaluation(tmp_path / name, replan_steps=k, policy={"type": "act", "sha256": digest})
    runs = read_runs([f"mine={tmp_path}/b", f"mine={tmp_path}/a"])
    assert [(run.name, run.method, run.replan_steps) for run in runs] == [
        ("mine k=20", "mine", 20),
        ("mine k=5", "mine", 5),
    ]
    assert [run.replan_steps for run in sweeps(runs)["mine"]] == [5, 20]
    runs = read_runs([tmp_path / name for name in "abc"])
    assert [run.method for run in runs] == ["act aaaaaaaa", "act aaaaaaaa", "act cccccccc"]
    assert [run.name for run in sweeps(runs)["act aaaaaaaa"]] == ["a", "b"]
    with pytest.raises(MemobenchError, match="'x'"):
        read_runs([f"x={tmp_path}/a", f"x={tmp_path}/c"])
    own = {"type": "act", "settings": {"n_action_steps": 35}}
    logs.evaluation(tmp_path / "own", replan_steps=None, policy=own)
    assert read_runs([tmp_path / "own"])[0].replan_steps == 35, "the policy's own interval, by its card"


def test_names_of_folders(tmp_path: Path) -> None:
    folders = [logs.evaluation(tmp_path / name / "eval") for name in ("a", "b")]
    assert [run.name for run in read_runs(folders)] == ["a/eval", "b/eval"]
    (run,) = read_runs([str(logs.evaluation(tmp_path / "lr=3"))])
    assert run.name == "lr=3", "an equals sign of a folder's own"
    for words in ([*folders, tmp_path / "a" / "x" / ".." / "eval"], [], ["=x"], ["x="]):
        with pytest.raises(MemobenchError, match=r"twice|no evaluation|NAME=FOLDER"):
            read_runs(words)


# --- notes ---


def test_rollouts_beyond_the_request_are_left_out(tmp_path: Path) -> None:
    folder = logs.evaluation(tmp_path / "a")
    protocol = {**SETTINGS, "tasks": ["one", "two_of_them"], "episodes": 3}
    write_evaluation(folder, facts(protocol, {"seed": 7}))
    (run,) = read_runs([folder])
    assert [task.rates["SR"].n for task in run.summary.tasks.values()] == [3, 3]
    assert run.notes == ["2 rollouts beyond those that were asked for left out"]
    assert write_report(folder).summary.tasks["one"].rates["SR"].n == 3
    assert read_run(folder).notes == run.notes, "they stay in the log"
    write_evaluation(folder, facts(protocol, {"seed": 9}))
    assert len(read_run(folder).records) == 4, "episodes 2, 3 and 4 were asked for, and 4 is missing"


def test_other_settings_are_noted_in_every_format(tmp_path: Path) -> None:
    for name, changes in (("a", {}), ("b", {"horizon": 600, "inputs": "privileged object state"}), ("c", {})):
        logs.evaluation(tmp_path / name, **{"inputs": "pixels", **changes})
    found = [f"{tmp_path}/{name}" for name in "abc"]
    words = "(horizon: 1200 and 600; inputs: pixels and privileged object state"
    report = evaluation_report(read_runs(found))
    for name in ("markdown", "table", "latex", "json"):
        text = " ".join(WRITERS[name](report).split()).replace("\\_", "_")
        assert f"a and b have different protocols {words}" in text, name
        assert "c was not run" not in text, name
    assert words in (write_html(found, tmp_path / "page").page).read_text()
    assert '"notices":[]' in (write_html([found[0], found[2]], tmp_path / "page").page).read_text()


def test_suites_are_not_mixed(tmp_path: Path) -> None:
    plain = evaluation(tmp_path / "plain")
    other = evaluation(tmp_path / "other", suite="strict", stand_ins=["cork__3"])
    with pytest.raises(MemobenchError, match="suite="):
        read_runs([plain, other])
    with pytest.raises(MemobenchError, match="suite="):
        write_html([other, plain], tmp_path / "page")
    with pytest.raises(MemobenchError, match="suite: "):
        compare_evaluations(*read_runs([plain]), *read_runs([other]))
    with pytest.raises(MemobenchError, match="--allow 'suite'"):
        compare_evaluations(*read_runs([plain]), *read_runs([other]), allow=["suite"])
    with pytest.raises(MemobenchError, match=r"\(suite: "):
        merge(tmp_path / "joined", [plain, other])
    (run,) = read_runs([other])
    assert ["strict suite" in headline(read_runs([folder])) for folder in (other, plain)] == [True, False]
    assert any("cork__3" in note for note in run.notes)


def test_suites_of_libero_are_joined_whatever_their_seeds(tmp_path: Path) -> None:
    for seed, suite in enumerate(("libero_spatial", "libero_goal")):
        own = {"memory_type": suite, "suite": suite, "seed_base": 7}
        write_log(tmp_path / suite, [record(task_names(suite=suite)[0], marks=[], **own)], type="act", seed=seed)
    (run,) = read_runs([tmp_path])
    assert (run.method, [*run.summary.memory_types]) == ("act", ["libero_spatial", "libero_goal"])
