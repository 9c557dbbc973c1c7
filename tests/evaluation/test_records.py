"""What an evaluation was run under: written with its first episode, read back, compared."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, differences, write_episodes
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, check_protocol, write_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import compare
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.html.write import write_html
from lerobot_memobench.evaluation.metrics import failure_counts, summarise
from lerobot_memobench.evaluation.records import read_protocol, read_rollouts, read_runs, sweeps
from lerobot_memobench.evaluation.report import build, render, write_report
from lerobot_memobench.evaluation.report_tables import departures, failures_table
from lerobot_memobench.run.shards import merge
from lerobot_memobench.tasks.failures import FAILURES
from tests.support import logs
from tests.support.logs import SETTINGS, evaluation, rollout


def record(task: str = "a_task", episode: int = 0, **changes: Any) -> dict[str, Any]:
    return logs.record(task, episode, **{"replan_steps": 20} | changes)


def test_the_environments_settings_stand_beside_the_log(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path, partial(write_protocol, tmp_path, SETTINGS))
    assert not list(tmp_path.iterdir())  # nothing before an episode has ended
    log.append(record())
    log.append(record("b", 3))
    assert read_protocol(tmp_path) == {**SETTINGS, "tasks": ["a_task", "b"], "episodes": 4, "policy": {}}
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_another_protocol_is_refused_before_a_line_is_written(tmp_path: Path) -> None:
    EpisodeLog(tmp_path, partial(write_protocol, tmp_path, SETTINGS)).append(record())
    EpisodeLog(tmp_path, partial(write_protocol, tmp_path, SETTINGS)).append(record(episode=1))  # another worker
    before = sorted((tmp_path / "episodes").iterdir()), (tmp_path / EVALUATION_FILE).read_bytes()
    with pytest.raises(MemobenchError, match="horizon: 1200 and 600"):
        EpisodeLog(tmp_path, partial(write_protocol, tmp_path, {**SETTINGS, "horizon": 600})).append(record("other"))
    assert before == (sorted((tmp_path / "episodes").iterdir()), (tmp_path / EVALUATION_FILE).read_bytes())


def test_a_log_alone_tells_what_it_can(tmp_path: Path) -> None:
    write_episodes(tmp_path, [record(), record(episode=1)])
    assert read_protocol(tmp_path) == {
        "tasks": ["a_task"],
        "episodes": 2,
        "seed_base": 7,
        "referent": "fixed",
        "replan_steps": 20,
        "policy": {},
    }
    write_episodes(tmp_path, [record(), record(episode=1, referent="random", replan_steps=None)])
    mixed = read_protocol(tmp_path)
    assert mixed["referent"] == ["fixed", "random"]
    assert mixed["replan_steps"] == [20, None]


def test_what_was_asked_for_comes_from_the_card(tmp_path: Path) -> None:
    EpisodeLog(tmp_path, partial(write_protocol, tmp_path, SETTINGS)).append(record())
    card = {"protocol": {**SETTINGS, "tasks": ["a_task", "b"], "episodes": 50}, "policy": {"type": "act"}}
    (tmp_path / EVALUATION_FILE).write_text(json.dumps(card))
    assert read_protocol(tmp_path) == {**card["protocol"], "policy": {"type": "act"}}


def test_differences_are_named_with_both_values() -> None:
    other = {**SETTINGS, "horizon": 600, "replan_steps": 5, "seed_base": 1000}
    assert differences(SETTINGS, other) == [
        "seed_base: 7 and 1000",
        "horizon: 1200 and 600",
        "replan_steps: None and 5",
    ]
    assert differences(SETTINGS, other, ignore={"replan_steps", "seed_base"}) == ["horizon: 1200 and 600"]
    assert differences(SETTINGS, SETTINGS) == differences({"horizon": 600}, {"referent": "fixed"}) == []
    a = {**SETTINGS, "tasks": ["x"], "policy": {"type": "act", "settings": {"steps": 1}}}
    b = {**SETTINGS, "tasks": ["x", "y"], "policy": {"type": "act", "settings": {"steps": 2}}}
    assert differences(a, b) == []
    assert differences(a, b, extent=True) == ["tasks: x and x, y"]
    assert differences(a, b, policy=True) == ["policy.settings.steps: 1 and 2"]
    assert differences(a, {**b, "policy": {}}, policy=True) == []


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
    assert [(run.name, run.method) for run in runs] == [
        ("a", "act aaaaaaaa"),
        ("b", "act aaaaaaaa"),
        ("c", "act cccccccc"),
    ]
    assert [run.name for run in sweeps(runs)["act aaaaaaaa"]] == ["a", "b"]
    own = logs.evaluation(tmp_path / "own", replan_steps=None)
    card(own, type="act", settings={"n_action_steps": 35})
    assert read_runs([own])[0].replan_steps == 35, "the policy's own interval, by its card"


def test_results_that_cannot_be_told_apart_are_named_after_folders(tmp_path: Path) -> None:
    for name, k in (("a", 5), ("b", 5), ("c", 20)):
        logs.evaluation(tmp_path / name, replan_steps=k)
    assert [run.method for run in read_runs([tmp_path / name for name in "abc"])] == ["a", "b", "c"]
    with pytest.raises(MemobenchError, match="two evaluations named 'x'"):
        read_runs([f"x={tmp_path}/a", f"x={tmp_path}/b"])


def test_rollouts_beyond_those_asked_for_are_not_counted(tmp_path: Path) -> None:
    """LeRobot runs whole batches; earlier versions logged what its last one held beyond."""
    folder = logs.evaluation(tmp_path / "a")
    told = {"protocol": {"tasks": ["one", "two_of_them"], "episodes": 3, "seed_base": 7}, "policy": {"seed": 7}}
    (folder / "card.json").write_text(json.dumps(told))
    (run,) = read_runs([folder])
    assert [row["SR"].n for row in run.summary.tasks.values()] == [3, 3]
    assert run.notes == ["2 rollouts beyond the 3 of each task that were asked for left out"]
    assert write_report(folder).summary.tasks["one"]["SR"].n == 3
    assert read_rollouts(folder)[1] == run.notes, "they stay in the log"
    (folder / "card.json").write_text(json.dumps({**told, "policy": {"seed": 9}}))
    logs.evaluation(folder)
    assert len(read_rollouts(folder)[0]) == 8, "episodes 2, 3 and 4 were asked for"


def test_evaluations_that_were_not_run_alike_are_shown_with_a_notice(tmp_path: Path) -> None:
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


def test_names_of_folders(tmp_path: Path) -> None:
    for name in ("a", "b"):
        logs.evaluation(tmp_path / name / "eval")
    folders = [tmp_path / "a" / "eval", tmp_path / "b" / "eval"]
    assert [run.name for run in read_runs(folders)] == ["a/eval", "b/eval"]
    (run,) = read_runs([str(logs.evaluation(tmp_path / "lr=3"))])
    assert run.name == "lr=3", "an equals sign of a folder's own"
    with pytest.raises(MemobenchError, match="given twice"):
        read_runs([*folders, tmp_path / "a" / "x" / ".." / "eval"])


@pytest.mark.parametrize(
    ("words", "message"), [([], "no evaluation"), (["=x"], "NAME=FOLDER"), (["x="], "NAME=FOLDER")]
)
def test_what_is_no_evaluation(words: list[str], message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        read_runs(words)


@pytest.fixture
def strict(tmp_path: Path) -> Path:
    """An evaluation of the strict suite whose failures are miscounts."""
    return evaluation(tmp_path / "strict", suite="strict")


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """One of the time when there was no other suite."""
    return evaluation(tmp_path / "published")


REFUSED = "report each suite by itself"


def test_reports_of_two_worlds_are_refused_and_stand_ins_are_told(published: Path, tmp_path: Path) -> None:
    libero = evaluation(tmp_path / "libero", world="libero", stand_ins=["cork__3"])
    with pytest.raises(MemobenchError, match=r"world=memobench and .* world=libero, .*report each world by itself"):
        read_runs([published, libero])
    with pytest.raises(MemobenchError, match="found --allow 'world'"):
        compare(*read_runs([published]), *read_runs([libero]), allow=["world"])
    with pytest.raises(MemobenchError, match=r"\(world: memobench and libero\)"):
        merge(tmp_path / "joined", [published, libero])
    (run,) = read_runs([libero])
    assert "published suite, world libero, 1 stand-in, referent fixed" in headline([run])
    assert any("cork__3" in note for note in run.notes)


def test_what_departs_from_the_papers_protocol_names_world_and_protocol(published: Path, tmp_path: Path) -> None:
    upstream = evaluation(tmp_path / "upstream", world="libero", protocol="upstream")
    (ours,), (theirs,) = (departures(*read_runs([folder]))[-1:] for folder in (published, upstream))
    assert (ours, theirs) == ("world memobench instead of libero", "protocol upstream instead of paper")


def test_reports_of_two_suites_are_refused(strict: Path, published: Path, tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=REFUSED):
        read_runs([published, strict])
    with pytest.raises(MemobenchError, match=REFUSED):
        write_html([strict, published], tmp_path / "page")
    with pytest.raises(MemobenchError, match="suite: published and strict"):
        compare(*read_runs([published]), *read_runs([strict]))
    with pytest.raises(MemobenchError, match="found --allow 'suite'"):
        compare(*read_runs([published]), *read_runs([strict]), allow=["suite"])
    with pytest.raises(MemobenchError, match=r"\(suite: published and strict\)"):
        merge(tmp_path / "joined", [published, strict])
    assert read_protocol(strict)["suite"] == "strict"
    assert "suite" not in read_protocol(published)


def test_one_log_of_two_suites_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "mixed"
    records = [rollout("one", "temporal", "S", [True], True, k, suite=["published", "strict"][k]) for k in range(2)]
    folder.mkdir()
    (folder / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    with pytest.raises(MemobenchError, match="of the suites published and strict"):
        read_runs([folder])


def test_the_papers_figures_stand_beside_the_published_suite_only(strict: Path, published: Path) -> None:
    assert build(read_runs([published]), paper=True).sections
    with pytest.raises(MemobenchError, match="leave out --with paper"):
        build(read_runs([strict]), paper=True)


def test_an_earlier_folder_goes_on_as_published_and_not_as_strict(tmp_path: Path) -> None:
    (tmp_path / EVALUATION_FILE).write_text('{"protocol": {"horizon": 1200}}')
    assert check_protocol(tmp_path, {"horizon": 1200, "suite": "published"})
    with pytest.raises(MemobenchError, match="suite: published and strict"):
        check_protocol(tmp_path, {"horizon": 1200, "suite": "strict"})
    empty = tmp_path / "empty"
    empty.mkdir()
    assert not check_protocol(empty, {"suite": "strict"})


def test_failures_of_strict_tasks_join_the_published_rows() -> None:
    def failed(failure: str, episode: int) -> dict[str, object]:
        return rollout("one", "temporal", "SU", [True, False], False, episode, failure=failure)

    plain = [failed("stale_memory", 0)]
    assert list(failure_counts(plain)) == list(FAILURES)
    counted = failure_counts([*plain, failed("miscount", 1), failed("miscount", 2), failed("wrong_place", 3)])
    assert counted == {**failure_counts(plain), "miscount": 2, "wrong_place": 1}
    published = [row[0] for row in failures_table(summarise(plain)).rows]
    table = failures_table(summarise([*plain, failed("miscount", 1)]))
    assert [row[0] for row in table.rows] == [*published, "miscount"]
    assert "Miscount: the event was done too seldom or too often." in str(table.note)
    assert "Miscount" not in str(failures_table(summarise(plain)).note)
