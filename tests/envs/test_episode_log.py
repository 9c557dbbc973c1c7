"""The episode log: what is written is read back, whatever happened to the process that wrote it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, has_log, read_episodes, write_episodes
from lerobot_memobench.errors import MemobenchError
from tests.support import logs


def record(task: str = "a_task", episode: int = 0, **changes: Any) -> dict[str, Any]:
    own = {
        "replan_steps": None,
        "prompt_steps": 0,
        "steps": 100,
        "scene_hash": "0123456789abcdef",
        "wall_s": 1.5,
    }
    return logs.record(task, episode, **own | changes)


def test_written_records_are_read_back_as_they_were(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path)
    assert not (tmp_path / "episodes").exists()
    written = [record("b", 1), record("b", 0), record("a", 2)]
    for item in written:
        log.append(item)
    problems: list[str] = []
    assert read_episodes(tmp_path, problems) == [written[2], written[1], written[0]]
    assert not problems


@pytest.mark.parametrize("task", ["../outside", ".hidden", "", 7])
def test_a_task_names_one_file_of_the_log_and_none_elsewhere(tmp_path: Path, task: object) -> None:
    with pytest.raises(MemobenchError, match=r"the task of a record of an episode is .*, which names no file"):
        EpisodeLog(tmp_path / "log").append(record() | {"task": task})
    assert not list(tmp_path.iterdir())


def test_one_file_per_task_and_process(tmp_path: Path) -> None:
    path = EpisodeLog(tmp_path).append(record("a"))
    assert path == tmp_path / "episodes" / f"a.{os.getpid()}.jsonl"


def test_the_newest_line_counts_whatever_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = EpisodeLog(tmp_path)
    log.append(record(steps=1))
    monkeypatch.setattr(os, "getpid", lambda: 1)  # sorts before any real process
    log.append(record(steps=2))
    assert [item["steps"] for item in read_episodes(tmp_path)] == [2]
    write_episodes(tmp_path, read_episodes(tmp_path))
    monkeypatch.undo()
    log.append(record(steps=3))
    assert [item["steps"] for item in read_episodes(tmp_path)] == [3]


def test_lines_that_contradict_each_other_are_said(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path)
    for success in (True, False):
        for episode in (1, 2):
            log.append(record("a", episode, success=success))
    log.append(record("a", 3))
    log.append(record("a", 3))
    log.append({**record("a", 4, success=False), "not_run": "no such place"})
    log.append(record("a", 4, success=True))
    problems: list[str] = []
    assert [item["success"] for item in read_episodes(tmp_path, problems)][:2] == [False, False]
    assert problems == [
        f"{tmp_path} has lines of success and of failure about 2 episodes, the first is a, episode 1; the newest line "
        "of each counts"
    ]


def test_episodes_of_other_referents_are_other_episodes(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path)
    log.append(record(referent="fixed"))
    log.append(record(referent="random"))
    assert [item["referent"] for item in read_episodes(tmp_path)] == ["fixed", "random"]


def test_a_plain_merged_file_is_enough(tmp_path: Path) -> None:
    records = [record("a", 0), record("a", 1)]
    write_episodes(tmp_path, records)
    assert read_episodes(tmp_path) == records
    assert has_log(tmp_path)
    assert not list(tmp_path.glob("*.part"))


def test_a_torn_last_line_is_left_out_and_named(tmp_path: Path) -> None:
    path = EpisodeLog(tmp_path).append(record("a", 0))
    whole = path.read_bytes()
    path.write_bytes(whole + json.dumps(record("a", 1)).encode()[:40])
    problems: list[str] = []
    assert [item["episode"] for item in read_episodes(tmp_path, problems)] == [0]
    assert len(problems) == 1
    assert str(path) in problems[0]
    assert "line 2" in problems[0]


def test_a_process_goes_on_after_a_torn_line_of_its_number(tmp_path: Path) -> None:
    path = EpisodeLog(tmp_path).append(record("a", 0))
    path.write_bytes(path.read_bytes() + b'{"task": "a", "epis')
    EpisodeLog(tmp_path).append(record("a", 1))
    problems: list[str] = []
    assert [item["episode"] for item in read_episodes(tmp_path, problems)] == [0, 1]
    assert len(problems) == 1


@pytest.mark.parametrize("cut", [1, 2, 17, 100])
def test_cutting_the_file_anywhere_loses_at_most_the_last_record(tmp_path: Path, cut: int) -> None:
    log = EpisodeLog(tmp_path)
    for k in range(3):
        path = log.append(record("a", k))
    path.write_bytes(path.read_bytes()[:-cut])
    episodes = [item["episode"] for item in read_episodes(tmp_path)]
    assert episodes == ([0, 1, 2] if cut == 1 else [0, 1])  # the line break alone is no loss


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("[1]", "expected an object"),
        ('{"task": "a"}', "found no memory_type"),
        (json.dumps(record(success="yes")), "expected true or false"),
        (json.dumps({**record(), "episode": "0"}), "expected an integer"),
        (json.dumps(record(checkpoints=[{"operation": "X", "first_step": 1}])), "checkpoints"),
        (json.dumps(record(task=3)), "found task = 3, expected text"),
    ],
)
def test_lines_that_are_no_rollout_are_named(tmp_path: Path, line: str, reason: str) -> None:
    (tmp_path / "episodes.jsonl").write_text(json.dumps(record("b")) + "\n" + line + "\n")
    problems: list[str] = []
    assert [item["task"] for item in read_episodes(tmp_path, problems)] == ["b"]
    assert len(problems) == 1
    assert reason in problems[0]


def test_bytes_that_are_no_text_are_named(tmp_path: Path) -> None:
    (tmp_path / "episodes.jsonl").write_bytes(b"\xff\xfe\x00\n" + json.dumps(record()).encode())
    problems: list[str] = []
    assert len(read_episodes(tmp_path, problems)) == 1
    assert "line 1" in problems[0]


def test_a_folder_without_a_log_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="no episode log"):
        read_episodes(tmp_path)
    with pytest.raises(MemobenchError, match="not a folder"):
        read_episodes(tmp_path / "missing")
    assert not has_log(tmp_path / "missing")


def test_a_record_that_is_no_json_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    for bad in (float("nan"), object()):
        with pytest.raises(MemobenchError, match="JSON"):
            EpisodeLog(tmp_path).append(record(wall_s=bad))
    assert not has_log(tmp_path)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match="cannot be written"):
        EpisodeLog(tmp_path / "file").append(record())


def test_a_killed_writer_loses_nothing_that_was_finished(tmp_path: Path) -> None:
    code = (
        "import json, sys; from lerobot_memobench.envs.episode_log import EpisodeLog; "
        "log, record = EpisodeLog(sys.argv[1]), json.loads(sys.argv[2]); "
        "[log.append({**record, 'episode': k}) for k in range(100_000)]"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, str(tmp_path), json.dumps(record("a"))])
    while not has_log(tmp_path) or len(read_episodes(tmp_path)) < 20:
        assert writer.poll() is None
    writer.kill()
    writer.wait()
    episodes = [item["episode"] for item in read_episodes(tmp_path)]
    assert len(episodes) >= 20
    assert episodes == list(range(len(episodes)))
