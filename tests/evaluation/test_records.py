"""Evaluations read back: protocol, names, methods, notes; evaluations of two suites or worlds are refused."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, differences, with_omitted, write_episodes
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, write_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import compare_evaluations
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.html import write_html
from lerobot_memobench.evaluation.metrics import failure_counts, summary_of
from lerobot_memobench.evaluation.records import read_protocol, read_run, read_runs, sweeps
from lerobot_memobench.evaluation.report import evaluation_report, failures_table, write_report
from lerobot_memobench.evaluation.tables import WRITERS
from lerobot_memobench.run.shards import merge
from lerobot_memobench.tasks.failures import FAILURES
from tests.support import logs
from tests.support.logs import SETTINGS, evaluation, rollout


def record(task: str = "a_task", episode: int = 0, **changes: Any) -> dict[str, Any]:
    return logs.record(task, episode, **{"replan_steps": 20} | changes)


# --- the protocol ---


def test_protocol_is_written_with_the_first_episode(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path, partial(write_protocol, tmp_path, SETTINGS))
    assert not list(tmp_path.iterdir())
    log.append(record())
    log.append(record("b", 3))
    EpisodeLog(tmp_path, partial(write_protocol, tmp_path, SETTINGS)).append(record(episode=1))  # another worker
    protocol = {**SETTINGS, "world": "libero", "tasks": ["a_task", "b"], "episodes": 4, "policy": {}}
    assert read_protocol(tmp_path) == protocol
    before = sorted((tmp_path / "episodes").iterdir()), (tmp_path / EVALUATION_FILE).read_bytes()
    with pytest.raises(MemobenchError, match="horizon: 1200 and 600"):
        EpisodeLog(tmp_path, partial(write_protocol, tmp_path, {**SETTINGS, "horizon": 600})).append(record("other"))
    assert before == (sorted((tmp_path / "episodes").iterdir()), (tmp_path / EVALUATION_FILE).read_bytes())
    card = {"protocol": {**protocol, "episodes": 50}, "policy": {"type": "act"}}
    (tmp_path / EVALUATION_FILE).write_text(json.dumps(card))
    assert read_protocol(tmp_path) == {**card["protocol"], "policy": {"type": "act"}}


def test_protocol_of_a_log_alone(tmp_path: Path) -> None:
    write_episodes(tmp_path, [record(), record(episode=1)])
    known = {"tasks": ["a_task"], "episodes": 2, "seed_base": 7, "referent": "fixed", "replan_steps": 20}
    assert read_protocol(tmp_path) == {**known, "world": "libero", "policy": {}}
    write_episodes(tmp_path, [record(), record(episode=1, referent="random", replan_steps=None)])
    mixed = read_protocol(tmp_path)
    assert mixed["referent"] == ["fixed", "random"]
    assert mixed["replan_steps"] == [20, None]


def test_differences_of_protocols() -> None:
    other = {**SETTINGS, "horizon": 600, "replan_steps": 5, "seed_base": 1000}
    found = ["seed_base: 7 and 1000", "horizon: 1200 and 600", "replan_steps: None and 5"]
    assert differences(SETTINGS, other) == found
    assert differences(SETTINGS, other, ignore={"replan_steps", "seed_base"}) == ["horizon: 1200 and 600"]
    assert differences(SETTINGS, SETTINGS) == differences({"horizon": 600}, {"referent": "fixed"}) == []
    a = {**SETTINGS, "tasks": ["x"], "policy": {"type": "act", "settings": {"steps": 1}}}
    b = {**SETTINGS, "tasks": ["x", "y"], "policy": {"type": "act", "settings": {"steps": 2}}}
    assert differences(a, b) == []
    assert differences(a, b, extent=True) == ["tasks: x and x, y"]
    assert differences(a, b, policy=True) == ["policy.settings.steps: 1 and 2"]
    assert differences(a, {**b, "policy": {}}, policy=True) == []


# --- names and methods ---


def card(folder: Path, **policy: object) -> None:
    content = {"protocol": {"tasks": [], "episodes": 4}, "policy": policy}
    (folder / "card.json").write_text(json.dumps(content))


def test_methods_are_names_policies_or_folders(tmp_path: Path) -> None:
    for name, k, digest in (("a", 5, "aaaaaaaaaaaa"), ("b", 20, "aaaaaaaaaaaa"), ("c", 5, "cccccccccccc")):
        card(logs.evaluation(tmp_path / name, replan_steps=k), type="act", sha256=digest)
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
    for name, k in (("d", 5), ("e", 5), ("f", 20)):
        logs.evaluation(tmp_path / name, replan_steps=k)
    assert [run.method for run in read_runs([tmp_path / name for name in "def"])] == ["d", "e", "f"]
    card(logs.evaluation(tmp_path / "own", replan_steps=None), type="act", settings={"n_action_steps": 35})
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
    """LeRobot runs whole batches; earlier versions logged all of the last one."""
    folder = logs.evaluation(tmp_path / "a")
    content = {"protocol": {"tasks": ["one", "two_of_them"], "episodes": 3, "seed_base": 7}, "policy": {"seed": 7}}
    (folder / "card.json").write_text(json.dumps(content))
    (run,) = read_runs([folder])
    assert [row["SR"].n for row in run.summary.tasks.values()] == [3, 3]
    assert run.notes == ["2 rollouts beyond those that were asked for left out"]
    assert write_report(folder).summary.tasks["one"]["SR"].n == 3
    assert read_run(folder).notes == run.notes, "they stay in the log"
    (folder / "card.json").write_text(json.dumps({**content, "policy": {"seed": 9}}))
    logs.evaluation(folder)
    assert len(read_run(folder).records) == 4, "episodes 2, 3 and 4 were asked for, and 4 is missing"


def test_other_settings_are_noted_in_every_format(tmp_path: Path) -> None:
    settings = {"horizon": 1200, "referent": "fixed", "inputs": "pixels"}
    for name, changes in (("a", {}), ("b", {"horizon": 600, "inputs": "privileged object state"}), ("c", {})):
        folder = logs.evaluation(tmp_path / name, inputs={**settings, **changes}["inputs"])
        write_protocol(folder, {**settings, **changes})
    found = [f"{tmp_path}/{name}" for name in "abc"]
    words = "(horizon: 1200 and 600; inputs: pixels and privileged object state"
    report = evaluation_report(read_runs(found))
    for name in ("markdown", "table", "latex", "json"):
        text = " ".join(WRITERS[name](report).split()).replace("\\_", "_")
        assert f"a and b have different protocols {words}" in text, name
        assert "c was not run" not in text, name
    assert words in (write_html(found, tmp_path / "page").page).read_text()
    assert '"notices":[]' in (write_html([found[0], found[2]], tmp_path / "page").page).read_text()


@pytest.mark.parametrize(("key", "value"), [("suite", "strict"), ("world", "memobench")])
def test_suites_and_worlds_are_not_mixed(tmp_path: Path, key: str, value: str) -> None:
    plain = evaluation(tmp_path / "plain")
    other = evaluation(tmp_path / "other", **{key: value}, stand_ins=["cork__3"])
    with pytest.raises(MemobenchError, match=f"{key}="):
        read_runs([plain, other])
    with pytest.raises(MemobenchError, match=f"{key}="):
        write_html([other, plain], tmp_path / "page")
    with pytest.raises(MemobenchError, match=f"{key}: "):
        compare_evaluations(*read_runs([plain]), *read_runs([other]))
    with pytest.raises(MemobenchError, match=f"--allow '{key}'"):
        compare_evaluations(*read_runs([plain]), *read_runs([other]), allow=[key])
    with pytest.raises(MemobenchError, match=rf"\({key}: "):
        merge(tmp_path / "joined", [plain, other])
    usual = {"suite": "published", "world": "libero"}[key]
    assert [with_omitted(read_protocol(folder))[key] for folder in (other, plain)] == [value, usual]
    (run,) = read_runs([other])
    named = {"suite": "strict suite", "world": "scenes that version 0.2 modelled in code"}[key]
    assert [named in headline(read_runs([folder])) for folder in (other, plain)] == [True, False]
    assert any("cork__3" in note for note in run.notes)
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    records = [rollout("one", "temporal", "S", [True], True, k, **({key: value} if k else {})) for k in range(2)]
    (mixed / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    with pytest.raises(MemobenchError, match=f"of the {key}s"):
        read_runs([mixed])


def test_failures_of_strict_tasks_follow_the_published_ones() -> None:
    def failed(failure: str, episode: int) -> dict[str, object]:
        return rollout("one", "temporal", "SU", [True, False], False, episode, failure=failure)

    plain = [failed("stale_memory", 0)]
    assert list(failure_counts(plain)) == list(FAILURES)
    counted = failure_counts([*plain, failed("miscount", 1), failed("miscount", 2), failed("wrong_place", 3)])
    assert counted == {**failure_counts(plain), "miscount": 2, "wrong_place": 1}
    published = failures_table(summary_of(plain))
    table = failures_table(summary_of([*plain, failed("miscount", 1)]))
    assert [row[0] for row in table.rows] == [*(row[0] for row in published.rows), "miscount"]
    assert "Miscount" in str(table.note)
    assert "Miscount" not in str(published.note)
