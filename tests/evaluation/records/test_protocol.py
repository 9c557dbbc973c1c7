"""What an evaluation was run under: written with its first episode, read back, compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import PROTOCOL_FILE, EpisodeLog, has_log, write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.protocol import CARD_FILE, differences, read_protocol

SETTINGS: dict[str, Any] = {
    "seed_base": 7,
    "referent": "fixed",
    "demonstration_prompt": True,
    "horizon": 1200,
    "replan_steps": None,
    "render": "default",
    "render_every": 1,
    "oracle_memory": False,
}


def record(task: str = "a_task", episode: int = 0, **changes: Any) -> dict[str, Any]:
    return {
        "task": task,
        "memory_type": "temporal",
        "episode": episode,
        "seed": 7 + episode,
        "referent": "fixed",
        "replan_steps": 20,
        "success": True,
        "checkpoints": [{"operation": "S", "first_step": 3, "ordered_step": 3}],
        **changes,
    }


def test_the_environments_settings_stand_beside_the_log(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path, SETTINGS)
    assert not list(tmp_path.iterdir())  # nothing before an episode has ended
    log.append(record())
    log.append(record("b", 3))
    assert read_protocol(tmp_path) == {**SETTINGS, "tasks": ["a_task", "b"], "episodes": 4, "policy": {}}
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_another_protocol_is_refused_before_a_line_is_written(tmp_path: Path) -> None:
    EpisodeLog(tmp_path, SETTINGS).append(record())
    EpisodeLog(tmp_path, SETTINGS).append(record(episode=1))  # another worker
    before = sorted((tmp_path / "episodes").iterdir()), (tmp_path / PROTOCOL_FILE).read_bytes()
    with pytest.raises(MemobenchError, match="horizon: 1200 and 600"):
        EpisodeLog(tmp_path, {**SETTINGS, "horizon": 600}).append(record("other"))
    assert before == (sorted((tmp_path / "episodes").iterdir()), (tmp_path / PROTOCOL_FILE).read_bytes())


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
    EpisodeLog(tmp_path, SETTINGS).append(record())
    card = {"protocol": {**SETTINGS, "tasks": ["a_task", "b"], "episodes": 50}, "policy": {"type": "act"}}
    (tmp_path / CARD_FILE).write_text(json.dumps(card))
    assert read_protocol(tmp_path) == {**card["protocol"], "policy": {"type": "act"}}


def test_no_evaluation_at_all(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="no episode log"):
        read_protocol(tmp_path)
    assert not has_log(tmp_path)


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_files_that_are_none_of_ours_are_named(tmp_path: Path, text: str) -> None:
    write_episodes(tmp_path, [record()])
    (tmp_path / PROTOCOL_FILE).write_text(text)
    with pytest.raises(MemobenchError, match=PROTOCOL_FILE):
        read_protocol(tmp_path)
    (tmp_path / PROTOCOL_FILE).unlink()
    (tmp_path / CARD_FILE).write_text(text)
    with pytest.raises(MemobenchError, match=CARD_FILE):
        read_protocol(tmp_path)


def test_differences_are_named_with_both_values() -> None:
    other = {**SETTINGS, "horizon": 600, "replan_steps": 5, "seed_base": 1000}
    assert differences(SETTINGS, other) == [
        "seed_base: 7 and 1000",
        "horizon: 1200 and 600",
        "replan_steps: None and 5",
    ]
    assert differences(SETTINGS, other, ignore={"replan_steps", "seed_base"}) == ["horizon: 1200 and 600"]
    assert differences(SETTINGS, SETTINGS) == []


def test_extent_and_policy_count_when_asked_for() -> None:
    a = {**SETTINGS, "tasks": ["x"], "episodes": 5, "policy": {"type": "act", "settings": {"steps": 1}}}
    b = {**SETTINGS, "tasks": ["x", "y"], "episodes": 5, "policy": {"type": "act", "settings": {"steps": 2}}}
    assert differences(a, b) == []
    assert differences(a, b, extent=True) == ["tasks: x and x, y"]
    assert differences(a, b, policy=True) == ["policy.settings.steps: 1 and 2"]


def test_what_one_side_does_not_tell_is_no_difference() -> None:
    assert differences({"horizon": 600}, {"referent": "fixed"}) == []
    assert differences({**SETTINGS, "policy": {"type": "act"}}, {**SETTINGS, "policy": {}}, policy=True) == []


def test_a_difference_of_any_length_is_a_part_of_a_sentence() -> None:
    (found,) = differences({"render": "a" * 5_000}, {"render": ["b" * 5_000]})
    assert found == f"render: {'a' * 79}… and {'b' * 79}…"
    (found,) = differences({"policy": {"k" * 5_000: 1}}, {"policy": {"k" * 5_000: 2}}, policy=True)
    assert found.endswith("kkk…: 1 and 2")
    assert len(found) < 100
