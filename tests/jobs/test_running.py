"""Independent jobs, and locks."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs import processes
from lerobot_memobench.jobs.processes import Advance, locked, run_jobs
from tests.support.note_job import Killed, Note


@pytest.fixture
def jobs(tmp_path: Path) -> list[Note]:
    made = [Note(tmp_path / str(number), number) for number in range(4)]
    for job in made:
        job.folder.mkdir()
    return made


@pytest.mark.parametrize("workers", [1, 2])
def test_finished_jobs_are_reported_first_and_not_run_again(jobs: list[Note], workers: int) -> None:
    jobs[2].run()
    heard: list[Advance] = []
    run_jobs(jobs, workers=workers, progress=heard.append)
    assert [job.runs for job in jobs] == [1, 1, 1, 1]
    assert [news.done for news in heard] == [1, 2, 3, 4]
    assert heard[0].seed == 2
    assert {news.seed: news.failure for news in heard} == {0: None, 1: "odd", 2: None, 3: "odd"}
    assert {(news.total, news.found) for news in heard} == {(4, 1)}


def test_killed_workers_are_reported(jobs: list[Note]) -> None:
    with pytest.raises(MemobenchError, match="killed"):
        run_jobs([jobs[0], Killed(jobs[1].folder, 1), *jobs[2:]], workers=2)


# --- locks ---


def test_one_run_at_a_time_in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with locked(tmp_path, tmp_path), pytest.raises(MemobenchError, match=str(tmp_path)), locked(tmp_path, tmp_path):
        pass
    with locked(tmp_path, tmp_path):  # it is free again
        assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(MemobenchError, match="WSL2"), locked(tmp_path, tmp_path):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="Windows locks files by another call")
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_disk_without_locks_is_noted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: int
) -> None:
    fcntl = pytest.importorskip("fcntl")
    reason = [number]

    def flock(descriptor: int, operation: int) -> None:
        raise OSError(reason[0], os.strerror(reason[0]))

    monkeypatch.setattr(fcntl, "flock", flock)
    processes.note_missing_locks.cache_clear()
    for _ in range(2):
        with locked(tmp_path, tmp_path):
            pass
    err = capsys.readouterr().err
    assert (err.count("\n"), os.strerror(number) in err) == (1, True)
    reason[0] = errno.EBADF
    with pytest.raises(OSError, match="descriptor"), locked(tmp_path, tmp_path):
        pass


def test_killed_processes_release_locks(tmp_path: Path) -> None:
    code = f"""
import pathlib, time
from lerobot_memobench.jobs.processes import locked
path = pathlib.Path({str(tmp_path)!r})
with locked(path, path):
    print("held", flush=True)
    time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(MemobenchError, match=str(tmp_path)), locked(tmp_path, tmp_path):
            pass
        holder.kill()
        holder.wait()
    with locked(tmp_path, tmp_path):
        pass
