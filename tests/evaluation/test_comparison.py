"""Comparison of two evaluations: pairing, refusal, figures counted by hand, intervals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import Comparison, compare_evaluations, comparison_report
from lerobot_memobench.evaluation.metrics import METRICS, rollout_value
from lerobot_memobench.evaluation.records import read_runs, unlike
from lerobot_memobench.evaluation.statistics import Contrast
from lerobot_memobench.evaluation.tables import to_markdown
from tests.support import logs

STOVE = "turn_on_the_stove_and_turn_it_off"


def compared(a: Path, b: Path, **options: Any) -> Comparison:
    first, second = read_runs([a, b])
    return compare_evaluations(first, second, **options)


def find(found: Comparison, scope: str, metric: str) -> Contrast:
    (row,) = [row for row in found.contrasts if (row.scope, row.metric) == (scope, metric)]
    return row


def folder(path: Path, reached: list[int], task: str = STOVE, operations: str = "SUU") -> Path:
    """A log with one rollout per number: that many of its checkpoints were satisfied, from the first."""
    records = [
        logs.rollout(task, "temporal", operations, [j < n for j in range(len(operations))], n == len(operations), k)
        for k, n in enumerate(reached)
    ]
    return logs.write_log(path, records)


def test_counted_by_hand(tmp_path: Path) -> None:
    """Of 8 episodes of each of two tasks, A solves the first 2 and B the first 5."""
    found = compared(logs.evaluation(tmp_path / "a", 2, 8), logs.evaluation(tmp_path / "b", 5, 8))
    assert (found.pairs, found.notes, found.control) == (16, [], None)
    average = find(found, "average of memory types", "SR")
    assert (average.a, average.b, average.only_a, average.only_b) == (0.25, 0.625, 0, 6)
    assert (average.p, average.value) == (2 / 64, 0.375)
    task = find(found, "one", "SR")
    assert (task.only_b, task.p, task.adjusted) == (3, 0.25, 0.5)  # two tasks: Holm doubles the smaller p
    assert find(found, "spatial", "MCR").value == 0.375
    assert find(found, "spatial", "MUR").p == 1.0  # both have all of them
    assert find(found, "one", "MUR").p == 2 / 8  # three differ, all one way
    assert not [row for row in found.contrasts if (row.scope, row.metric) == ("one", "MCR")]
    report = comparison_report(found)
    assert f"| {'average of memory types'} | SR | 16 | 25.0 | 62.5 | +37.5 | " in to_markdown(report)
    assert "| 0 / 6 | 0.031 |" in to_markdown(report)
    first = json.loads(json.dumps(report.data))["differences"][0]
    assert (first["test"], first["difference"]) == ("mcnemar_exact", 37.5)


def test_rates_are_those_of_the_report(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for name in ("a", "b"):
        records = []
        for task, memory_type, operations in (
            ("x", "temporal", "SU"),
            (STOVE, "temporal", "SSC"),
            ("y", "spatial", "SUC"),
        ):
            for k in range(10):
                done = [bool(value) for value in rng.random(len(operations)) < 0.6]
                records.append(logs.rollout(task, memory_type, operations, done, all(done), k))
        logs.write_log(tmp_path / name, records)
    a, b = read_runs([tmp_path / "a", tmp_path / "b"])
    found = compare_evaluations(a, b)
    for metric in METRICS:
        for scope, rows in (("average of memory types", "average"), ("temporal", "memory_types")):
            row = find(found, scope, metric)
            for run, value in ((a, row.a), (b, row.b)):
                rates = getattr(run.summary, rows)
                assert value == (rates[metric] if scope == "average of memory types" else rates[scope][metric]).value
    assert find(found, "stove_transition", "SR").a == find(found, STOVE, "SR").a, "the family has one task here"


def test_a_rollouts_share_of_an_operation() -> None:
    record = logs.rollout("t", "temporal", "SSU", [True, False, False], False, 0)
    assert [rollout_value(record, metric) for metric in METRICS] == [0.0, 0.5, 0.0, None]


# --- intervals ---


def test_pairs_narrow_the_interval(tmp_path: Path) -> None:
    """B solves one episode more than A: drawn together, the difference hardly varies."""
    a, b = folder(tmp_path / "a", [3, 0] * 25), folder(tmp_path / "b", [3, 0] * 24 + [3, 3])
    low, high = find(compared(a, b), "temporal", "SR").interval
    assert low <= 0.02 <= high
    # Wilson's interval of one pair in 50 that differs reaches 0.105; a bootstrap alone would end at 0.06.
    assert 0.1 < high - low < 0.12, "independent samples of 50 would give about 0.4"


@pytest.mark.slow
def test_the_interval_covers_the_truth_about_as_often_as_it_says(tmp_path: Path) -> None:
    rng, covered = np.random.default_rng(11), 0
    for number in range(60):
        luck = rng.random((60, 2))
        a = folder(tmp_path / f"a{number}", [3 * int(x < 0.2) for x in luck[:, 0]])
        b = folder(tmp_path / f"b{number}", [3 * int(x < 0.6) for x in luck[:, 1]])
        low, high = find(compared(a, b, permutations=100), STOVE, "SR").interval
        covered += low <= 0.4 <= high
    assert 52 <= covered <= 60


# --- which evaluations compare ---


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"replan_steps": 20}, "replan_steps: 5 and 20"),
        ({"referent": "random"}, "referent: fixed and random"),
        ({"scene_hash": "another"}, "initial scenes"),
        ({"first_seed": 1007}, "seed"),
    ],
)
def test_differences_of_logs_are_refused_by_name_and_may_be_allowed(
    tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b", **changes)
    with pytest.raises(MemobenchError, match=named):
        compared(a, b)
    (name,) = changes
    assert compared(a, b, allow=["seed_base" if name == "first_seed" else name]).pairs == 8


@pytest.mark.parametrize(("setting", "value"), [("horizon", 600), ("seed_base", 1007), ("prompt_in", "reset")])
def test_settings_beside_the_log_count(tmp_path: Path, setting: str, value: Any) -> None:
    changes = {"first_seed": value} if setting == "seed_base" else {setting: value}
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b", **changes)
    if setting == "prompt_in":  # the policy's: it may differ, with a note
        assert compared(a, b).notes[0] == "compared although prompt_in: steps and reset"
        return
    with pytest.raises(MemobenchError, match=f"{setting}: .* and {value}.*--allow {setting}"):
        compared(a, b)


def test_another_mujoco_is_named(tmp_path: Path) -> None:
    """By the cards: in the refusal, and as a note where it is allowed."""
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b", scene_hash="another")
    for each, version in ((a, "3.9.0"), (b, "4.0.0")):
        card = logs.card(logs.SETTINGS | {"replan_steps": 5, "tasks": ["one", "two_of_them"], "episodes": 4})
        card["runs"][0]["versions"] = {"mujoco": version, "python": "3.12.1"}
        write_evaluation(each, card)
    with pytest.raises(MemobenchError, match=r"a ran under MuJoCo 3.9.0 and b under 4.0.0"):
        compared(a, b)
    (sentence,) = unlike(read_runs([a, b]))
    assert sentence in compared(a, b, allow=["scene_hash"]).notes
    (b / "evaluation.json").write_text((a / "evaluation.json").read_text())
    assert sentence not in compared(a, b, allow=["scene_hash"]).notes


def test_two_salts_are_two_draws_of_one_protocol(tmp_path: Path) -> None:
    """Episodes whose variants both salts drew alike are paired, and the reader is informed."""
    both = []
    for name, salt, variants in (("a", "1" * 32, [0, 1, 0, 1]), ("b", "2" * 32, [0, 0, 1, 1])):
        records = [
            logs.rollout("t", "object", "S", [True], name == "b", k, referent="drawn", variant=variant, salt=salt)
            for k, variant in enumerate(variants)
        ]
        both.append(logs.write_log(tmp_path / name, records))
    found = compared(*both)
    assert (found.pairs, find(found, "average of memory types", "SR").value) == (2, 1.0)
    assert [note.partition(":")[0] for note in found.notes] == [
        f"a has the salt {'1' * 32} and b {'2' * 32}",
        *("2 episodes only in a left out", "2 episodes only in b left out"),
    ]
    assert unlike(read_runs(both)) == [found.notes[0]]


def test_all_that_must_be_allowed_is_named_at_once(tmp_path: Path) -> None:
    a = logs.evaluation(tmp_path / "a")
    b = logs.evaluation(tmp_path / "b", scene_hash="another", referent="random", replan_steps=20, horizon=600)
    with pytest.raises(MemobenchError) as caught:
        compared(a, b, allow=["render"])
    names = str(caught.value).replace("--allow ", "").rsplit(": ", 1)[1].split()
    assert sorted(names) == ["horizon", "referent", "replan_steps", "scene_hash"]
    assert compared(a, b, allow=["render", *names]).pairs == 8


def test_what_cannot_be_paired_is_refused(tmp_path: Path) -> None:
    a = logs.evaluation(tmp_path / "a")
    logs.write_log(tmp_path / "b", [logs.rollout("other", "object", "S", [True], True, 0)])
    with pytest.raises(MemobenchError, match="no episode in common"):
        compared(a, tmp_path / "b")
    with pytest.raises(MemobenchError, match="replan_steps"):
        compared(a, tmp_path / "b", allow=["replan_step"])
    for name, operations in (("c", "SU"), ("d", "SC")):
        logs.write_log(tmp_path / name, [logs.rollout("t", "temporal", operations, [True, True], True, 0)])
    with pytest.raises(MemobenchError, match="other checkpoints"):
        compared(tmp_path / "c", tmp_path / "d")
