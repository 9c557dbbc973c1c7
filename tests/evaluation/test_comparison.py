"""Comparison of two evaluations: pairing, refusal, and figures counted by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import Comparison, Difference, compare, comparison_report
from lerobot_memobench.evaluation.metrics import value_of
from lerobot_memobench.evaluation.records import read_runs, unlike
from lerobot_memobench.evaluation.report_tables import AVERAGE
from lerobot_memobench.evaluation.tables import markdown
from tests.support import logs


def compared(a: Path, b: Path, **options: Any) -> Comparison:
    first, second = read_runs([a, b])
    return compare(first, second, **options)


def find(found: Comparison, scope: str, metric: str) -> Difference:
    (row,) = [row for row in found.differences if (row.scope, row.metric) == (scope, metric)]
    return row


def test_counted_by_hand(tmp_path: Path) -> None:
    """Of 8 episodes of each of two tasks, A solves the first 2 and B the first 5."""
    a, b = logs.evaluation(tmp_path / "a", 2, 8), logs.evaluation(tmp_path / "b", 5, 8)
    found = compared(a, b)
    assert found.pairs == 16
    assert found.notes == ()
    average = find(found, AVERAGE, "SR")
    assert (average.a, average.b, average.only_a, average.only_b) == (0.25, 0.625, 0, 6)
    assert average.p == 2 / 64
    assert average.value == 0.375
    task = find(found, "one", "SR")
    assert (task.only_b, task.p, task.adjusted) == (3, 0.25, 0.5)  # two tasks: Holm doubles the smaller p
    assert find(found, "spatial", "MCR").value == 0.375
    assert find(found, "spatial", "MUR").p == 1.0  # both have all of them
    assert find(found, "one", "MUR").p == 2 / 8  # three differ, all one way
    assert not [row for row in found.differences if (row.scope, row.metric) == ("one", "MCR")]


def test_a_rollouts_share_of_an_operation() -> None:
    record = logs.rollout("t", "temporal", "SSU", [True, False, False], False, 0)
    assert [value_of(record, metric) for metric in ("SR", "MSR", "MUR", "MCR")] == [0.0, 0.5, 0.0, None]


def test_only_common_episodes_are_compared(tmp_path: Path) -> None:
    found = compared(logs.evaluation(tmp_path / "a", 2, 4), logs.evaluation(tmp_path / "b", 2, 6))
    assert found.pairs == 8
    assert found.notes == ("4 episodes only in b left out",)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"replan_steps": 20}, "replan_steps: 5 and 20"),
        ({"referent": "random"}, "referent: fixed and random"),
        ({"scene_hash": "another"}, "initial scenes"),
    ],
)
def test_what_differs_is_refused_by_name_and_may_be_allowed(
    tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b", **changes)
    with pytest.raises(MemobenchError, match=named):
        compared(a, b)
    (name,) = changes
    found = compared(a, b, allow=[name])
    assert found.pairs == 8
    if name != "scene_hash":
        assert found.notes[0] == f"compared although {named}"


def test_another_variant_of_a_scene_is_another_episode(tmp_path: Path) -> None:
    a, b = (logs.evaluation(tmp_path / str(k), referent="random", variant=k) for k in (0, 1))
    with pytest.raises(MemobenchError, match=r"do not have the same variants, the first is .*--allow referent"):
        compared(a, b)
    assert compared(a, b, allow=["referent"]).pairs == 8


@pytest.mark.parametrize(
    ("setting", "value"), [("horizon", 600), ("render", "fast"), ("seed_base", 1007), ("demonstration_prompt", False)]
)
def test_settings_beside_the_log_count(tmp_path: Path, setting: str, value: Any) -> None:
    settings = {"seed_base": 7, "referent": "fixed", "demonstration_prompt": True, "horizon": 1200, "render": "default"}
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b")
    (a / "protocol.json").write_text(json.dumps(settings))
    (b / "protocol.json").write_text(json.dumps({**settings, setting: value}))
    with pytest.raises(MemobenchError, match=f"{setting}: .* and {value}.*--allow {setting}"):
        compared(a, b)


def test_who_sees_the_prompt_is_the_policys_and_told(tmp_path: Path) -> None:
    settings = {"seed_base": 7, "referent": "fixed", "prompt_in": "steps"}
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b")
    (a / "protocol.json").write_text(json.dumps(settings))
    (b / "protocol.json").write_text(json.dumps({**settings, "prompt_in": "reset"}))
    assert compared(a, b).notes[0] == "compared although prompt_in: steps and reset"


def test_another_mujoco_is_told(tmp_path: Path) -> None:
    """By the cards: of the refused, why their scenes differ, and as a note of what was allowed."""
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b", scene_hash="another")
    for folder, version in ((a, "3.9.0"), (b, "4.0.0")):
        card = {"protocol": {}, "runs": [{"versions": {"mujoco": version, "python": "3.12.1"}}]}
        (folder / "card.json").write_text(json.dumps(card))
    sentence = "a ran under MuJoCo 3.9.0 and b under 4.0.0: scenes start and move slightly otherwise"
    with pytest.raises(MemobenchError, match=sentence):
        compared(a, b)
    assert sentence in compared(a, b, allow=["scene_hash"]).notes
    assert unlike(read_runs([a, b])) == [sentence]
    (b / "card.json").write_text((a / "card.json").read_text())
    assert sentence not in compared(a, b, allow=["scene_hash"]).notes


def test_all_that_must_be_allowed_is_named_at_once(tmp_path: Path) -> None:
    settings = {"seed_base": 7, "horizon": 1200, "render": "default", "referent": "fixed"}
    a = logs.evaluation(tmp_path / "a")
    b = logs.evaluation(tmp_path / "b", scene_hash="another", referent="random", replan_steps=20)
    (a / "protocol.json").write_text(json.dumps(settings))
    (b / "protocol.json").write_text(json.dumps({**settings, "horizon": 600, "render": "fast", "referent": "random"}))
    with pytest.raises(MemobenchError) as caught:
        compared(a, b, allow=["render"])
    told = str(caught.value)
    assert told.count("--allow") == 4
    assert "initial scenes" in told
    names = told.replace("--allow ", "").rsplit(": ", 1)[1].split()
    assert sorted(names) == ["horizon", "referent", "replan_steps", "scene_hash"]
    assert compared(a, b, allow=["render", *names]).pairs == 8


def test_other_seeds_are_other_episodes(tmp_path: Path) -> None:
    a, b = logs.evaluation(tmp_path / "a"), logs.evaluation(tmp_path / "b", seed=99)
    with pytest.raises(MemobenchError, match="seed"):
        compared(a, b)
    assert compared(a, b, allow=["seed_base"]).pairs == 8


def test_nothing_in_common_and_unknown_names(tmp_path: Path) -> None:
    a = logs.evaluation(tmp_path / "a")
    write_episodes(tmp_path / "b", [logs.rollout("other", "object", "S", [True], True, 0)])
    with pytest.raises(MemobenchError, match="no episode in common"):
        compared(a, tmp_path / "b")
    with pytest.raises(MemobenchError, match="replan_steps"):
        compared(a, tmp_path / "b", allow=["replan_step"])


def test_versions_of_a_task_do_not_pair(tmp_path: Path) -> None:
    for name, operations in (("a", "SU"), ("b", "SC")):
        write_episodes(tmp_path / name, [logs.rollout("t", "temporal", operations, [True, True], True, 0)])
    with pytest.raises(MemobenchError, match="other checkpoints"):
        compared(tmp_path / "a", tmp_path / "b")


def test_written_as_a_table_and_as_json(tmp_path: Path) -> None:
    found = comparison_report(compared(logs.evaluation(tmp_path / "a", 2, 8), logs.evaluation(tmp_path / "b", 5, 8)))
    assert f"| {AVERAGE} | SR | 16 | 25.0 | 62.5 | +37.5 | 0 / 6 | 0.031 |" in markdown(found)
    data = json.loads(json.dumps(found.data))
    assert data["differences"][0]["test"] == "mcnemar_exact"
    assert data["differences"][0]["difference"] == 37.5
