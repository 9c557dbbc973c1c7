"""Independent pieces of work: run, found finished again, told of once each."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import dill
import pytest
from filelock import lock_descriptor
from note_job import Note

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.job import Advance
from lerobot_memobench.jobs.locking import locked, taking_turns
from lerobot_memobench.jobs.running import run_jobs

needs_datatrove = pytest.mark.skipif(find_spec("datatrove") is None, reason="datatrove is not installed")


@pytest.fixture
def jobs(tmp_path: Path) -> list[Note]:
    made = [Note(tmp_path / str(number), number) for number in range(4)]
    for job in made:
        job.folder.mkdir()
    return made


@pytest.mark.parametrize(
    ("executor", "workers"),
    [("processes", 1), ("processes", 2), pytest.param("local", 2, marks=needs_datatrove)],
)
def test_what_is_finished_is_not_run_again(jobs: list[Note], tmp_path: Path, executor: str, workers: int) -> None:
    jobs[2].run()
    heard: list[Advance] = []
    assert run_jobs(jobs, workers=workers, progress=heard.append, executor=executor, logs=tmp_path / "logs")
    assert [job.runs for job in jobs] == [1, 1, 1, 1]
    assert [news.done for news in heard] == [1, 2, 3, 4]
    assert heard[0].seed == 2  # found ones are told first
    assert {news.seed: news.failure for news in heard} == {0: None, 1: "odd", 2: None, 3: "odd"}
    assert {(news.total, news.found) for news in heard} == {(4, 1)}


def test_nothing_is_begun_when_all_is_there(jobs: list[Note], tmp_path: Path) -> None:
    for job in jobs:
        job.run()
    assert run_jobs(jobs, logs=tmp_path / "logs")
    assert [job.runs for job in jobs] == [1, 1, 1, 1]


@needs_datatrove
def test_a_datatrove_rank_takes_neighbours_and_can_be_pickled(jobs: list[Note]) -> None:
    from lerobot_memobench.jobs.datatrove_steps import JobsStep

    step = dill.loads(dill.dumps(JobsStep(jobs)))  # noqa: S301 - pickled in this line
    list(step.run(rank=1, world_size=2))
    assert [job.finished() for job in jobs] == [False, False, True, True]


def test_one_run_at_a_time_in_a_folder(tmp_path: Path) -> None:
    with (
        locked(tmp_path, tmp_path),
        pytest.raises(MemobenchError, match="another run is writing to"),
        locked(tmp_path, tmp_path),
    ):
        pass
    with locked(tmp_path, tmp_path):  # free again, and nothing is left behind
        assert list(tmp_path.iterdir()) == []


def test_no_folder_is_held_on_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(MemobenchError, match="WSL2"), locked(tmp_path, tmp_path):
        pass


def test_one_after_another_at_a_file(tmp_path: Path) -> None:
    path = tmp_path / "cache.lock"
    with taking_turns(path), path.open() as other:
        assert not lock_descriptor(other.fileno(), blocking=False)
    with path.open() as other:
        assert lock_descriptor(other.fileno(), blocking=False)


@pytest.mark.parametrize("hold", ["taking_turns(path)", "locked(path.parent, path.parent)"])
def test_a_killed_process_lets_go(tmp_path: Path, hold: str) -> None:
    path = tmp_path / "cache.lock"
    code = f"""
import pathlib, time
from lerobot_memobench.jobs.locking import locked, taking_turns
path = pathlib.Path({str(path)!r})
with {hold}:
    print("held", flush=True)
    time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        holder.kill()
        holder.wait()
    with taking_turns(path), locked(tmp_path, tmp_path):
        pass
