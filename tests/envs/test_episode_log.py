"""The episode log: written lines are read back, also after a killed writer; unreadable lines are skipped and named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, has_log, line_of, log_text, read_lines, write_episodes
from lerobot_memobench.errors import MemobenchError
from tests.support import logs


def record(task: str = "a", episode: int = 0, **changes: Any) -> dict[str, Any]:
    own = {"prompt_steps": 0, "steps": 100, "scene_hash": "0123456789abcdef", "wall_s": 1.5}
    return line_of(logs.record(task, episode, **own | changes))


def test_records_are_read_back_sorted(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path)
    assert not (tmp_path / "episodes").exists()
    written = [record("b", 1), record("b", 0), record("a", 2)]
    paths = {log.append(item) for item in written}
    assert paths == {tmp_path / "episodes" / f"{task}.{os.getpid()}.jsonl" for task in "ab"}
    problems: list[str] = []
    assert read_lines(tmp_path, problems) == [written[2], written[1], written[0]]
    assert not problems


def test_newest_line_counts_in_any_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = EpisodeLog(tmp_path)
    log.append(record(steps=1))
    monkeypatch.setattr(os, "getpid", lambda: 1)  # sorts before any real process
    log.append(record(steps=2))
    assert [item["steps"] for item in read_lines(tmp_path)] == [2]
    write_episodes(tmp_path, read_lines(tmp_path))
    monkeypatch.undo()
    log.append(record(steps=3))
    assert [item["steps"] for item in read_lines(tmp_path)] == [3]


def test_a_rollout_counts_before_lines_of_an_episode_not_run(tmp_path: Path) -> None:
    """Whether the merged file or a worker's has it, and whichever is newer."""
    ran, absent = record(), record(success=False, not_run="no scene")
    EpisodeLog(tmp_path).append(absent)
    for merged in ([absent], [ran], [ran, absent]):
        (tmp_path / "episodes.jsonl").write_text(log_text(merged))
        write_episodes(tmp_path, [ran])
        assert read_lines(tmp_path) == [ran]
        assert (tmp_path / "episodes.jsonl").read_text() == log_text([ran])
    EpisodeLog(tmp_path / "resumed").append(ran)
    EpisodeLog(tmp_path / "resumed").append(absent)
    assert read_lines(tmp_path / "resumed") == [ran]


@pytest.mark.parametrize("removed", [1, 2, 17, 100])
def test_torn_file_loses_at_most_its_last_record(tmp_path: Path, removed: int) -> None:
    for k in range(3):
        path = EpisodeLog(tmp_path).append(record("a", k))
    path.write_bytes(path.read_bytes()[:-removed])
    problems: list[str] = []
    left = [0, 1, 2] if removed == 1 else [0, 1]  # the line break alone is no loss
    assert [item["episode"] for item in read_lines(tmp_path, problems)] == left
    assert [str(path) in problem and "line 3" in problem for problem in problems] == [True] * (removed > 1)
    EpisodeLog(tmp_path).append(record("a", 3))  # a later process with the same id
    assert [item["episode"] for item in read_lines(tmp_path)] == [*left, 3]


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (b"[1]", "object"),
        (b'{"task": "a"}', "memory_type"),
        (json.dumps(record(success="yes")).encode(), "success"),
        (json.dumps({**record(), "episode": "0"}).encode(), "episode"),
        (json.dumps(record(checkpoints=[{"operation": "X", "first_step": 1}])).encode(), "checkpoints"),
        (json.dumps(record(task=3)).encode(), "task"),
        (json.dumps({**record(), "suite": "strict"}).encode(), "suite"),
        (b"\xff\xfe\x00", "line 2"),
    ],
)
def test_invalid_lines_are_skipped_and_named(tmp_path: Path, line: bytes, named: str) -> None:
    (tmp_path / "episodes.jsonl").write_bytes(json.dumps(record("b")).encode() + b"\n" + line + b"\n")
    problems: list[str] = []
    assert [item["task"] for item in read_lines(tmp_path, problems)] == ["b"]
    assert len(problems) == 1
    assert named in problems[0]


def test_folders_without_a_log_and_bad_records_are_errors(tmp_path: Path) -> None:
    for folder, found in ((tmp_path, "no episode log"), (tmp_path / "missing", "not a folder")):
        with pytest.raises(MemobenchError, match=found):
            read_lines(folder)
        assert not has_log(folder)
    for bad in (
        record(wall_s=float("nan")),
        record(wall_s=object()),
        *({**record(), "task": t} for t in ("../x", "", 7)),
    ):
        with pytest.raises(MemobenchError):
            EpisodeLog(tmp_path / "log").append(bad)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match=r"cannot be written"):
        EpisodeLog(tmp_path / "file").append(record())


def test_killed_writer_loses_no_finished_record(tmp_path: Path) -> None:
    code = (
        "import json, sys; from lerobot_memobench.envs.episode_log import EpisodeLog; "
        "log, record = EpisodeLog(sys.argv[1]), json.loads(sys.argv[2]); "
        "[log.append({**record, 'episode': k}) for k in range(100_000)]"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, str(tmp_path), json.dumps(record())])
    while not has_log(tmp_path) or len(read_lines(tmp_path)) < 20:
        assert writer.poll() is None
    writer.kill()
    writer.wait()
    episodes = [item["episode"] for item in read_lines(tmp_path)]
    assert len(episodes) >= 20
    assert episodes == list(range(len(episodes)))
