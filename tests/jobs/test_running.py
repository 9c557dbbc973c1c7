"""Independent jobs, here or on Slurm, and locks."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import lock_descriptor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs import processes
from lerobot_memobench.jobs.processes import Advance, locked, taking_turns
from lerobot_memobench.jobs.running import run_jobs
from lerobot_memobench.jobs.slurm import Needs, Slurm, read_options, run_part
from tests.support.note_job import Killed, Note
from tests.support.sbatch import Sbatch


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
    assert run_jobs(jobs, workers=workers, progress=heard.append)
    assert [job.runs for job in jobs] == [1, 1, 1, 1]
    assert [news.done for news in heard] == [1, 2, 3, 4]
    assert heard[0].seed == 2
    assert {news.seed: news.failure for news in heard} == {0: None, 1: "odd", 2: None, 3: "odd"}
    assert {(news.total, news.found) for news in heard} == {(4, 1)}
    assert run_jobs(jobs, slurm=Slurm((), Needs(), Path("/nowhere"))), "finished jobs are not submitted"


def test_killed_workers_are_reported(jobs: list[Note]) -> None:
    with pytest.raises(MemobenchError, match="killed"):
        run_jobs([jobs[0], Killed(jobs[1].folder, 1), *jobs[2:]], workers=2)


# --- Slurm ---


def test_slurm_runs_an_array_and_a_last_job(jobs: list[Note], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sbatch = Sbatch(tmp_path / "bin", monkeypatch)
    finished = tmp_path / "finished"
    jobs[0].run()
    slurm = Slurm(read_options("--partition=gpu --gres=gpu:1"), Needs(2, 9, gpus=1), tmp_path / "logs", 1)
    assert not run_jobs(jobs, workers=2, slurm=slurm, finish=finished.touch)
    make, finish = sbatch.calls
    assert {"--array=0-2%2", "--cpus-per-task=2", "--mem=9G", "--partition=gpu", "--gres=gpu:1"} <= set(make)
    assert not any(word.startswith("--gpus") for word in make), "the user's options ask for GPUs"
    assert {"--dependency=afterany:4711", "--partition=gpu"} <= set(finish)
    assert "--gres=gpu:1" not in finish
    for member in ("0", "2"):
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", member)
        run_part("make", tmp_path / "logs")
    assert [job.finished() for job in jobs] == [True, True, False, True]
    with pytest.raises(MemobenchError, match=r"1 of 3 .*\(2\)"):
        run_part("finish", tmp_path / "logs")
    assert not finished.exists()
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "1")
    run_part("make", tmp_path / "logs")
    run_part("make", tmp_path / "logs")  # requeued
    run_part("finish", tmp_path / "logs")
    assert finished.exists()
    assert [job.runs for job in jobs] == [1, 1, 1, 1]


def test_submitted_command_runs(jobs: list[Note], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sbatch = Sbatch(tmp_path / "bin", monkeypatch)
    run_jobs(jobs, slurm=Slurm(read_options("--partition=cpu"), Needs(), tmp_path / "a log's folder"))
    ((*_, wrapped),) = sbatch.calls
    command = wrapped.removeprefix("--wrap=")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))  # of the pickled job's class
    subprocess.run(command, shell=True, check=True, cwd="/")
    assert [job.runs for job in jobs] == [1, 1, 1, 1], "one member runs neighbouring jobs"


@pytest.mark.parametrize(
    ("options", "requested"),
    [
        ("--time=1:00", {"--cpus-per-task=2", "--mem=8G", "--gpus-per-task=1"}),
        ("--cpus-per-task=8", {"--cpus-per-task=8", "--mem=8G"}),
        ("--mem-per-cpu=3G", {"--mem-per-cpu=3G"}),
        ("--gpus=2", {"--gpus=2"}),
    ],
)
def test_a_job_requests_its_needs_unless_the_user_does(options: str, requested: set[str]) -> None:
    found = Slurm(read_options(options), Needs(cores=2, memory_gb=8, gpus=1), Path("logs")).requested
    assert requested <= set({word.partition("=")[0]: word for word in found}.values())  # the last of a name counts
    assert sum(word.startswith("--mem") for word in found) == 1
    assert sum(word.startswith(("--gpus", "--gres")) for word in found) == 1


@pytest.mark.parametrize("text", ["", "partition=cpu", "--partition cpu", "-p cpu"])
def test_short_options_of_sbatch_are_refused(text: str) -> None:
    with pytest.raises(MemobenchError, match="--partition=gpu"):
        read_options(text)


def test_failures_of_sbatch_are_reported(jobs: list[Note], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slurm = Slurm(("--partition=none",), Needs(), tmp_path / "logs")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MemobenchError, match="no sbatch"):
        run_jobs(jobs, slurm=slurm)
    Sbatch(tmp_path / "bin", monkeypatch, refuses="invalid partition")
    with pytest.raises(MemobenchError, match="invalid partition"):
        run_jobs(jobs, slurm=slurm)


# --- locks ---


def test_one_run_at_a_time_in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        locked(tmp_path, tmp_path),
        pytest.raises(MemobenchError, match=str(tmp_path)),
        locked(tmp_path, tmp_path),
    ):
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
        with locked(tmp_path, tmp_path), taking_turns(tmp_path / "lock"):
            pass
    err = capsys.readouterr().err
    assert (err.count("\n"), os.strerror(number) in err) == (1, True)
    reason[0] = errno.EBADF
    with pytest.raises(OSError, match="descriptor"), locked(tmp_path, tmp_path):
        pass


def test_killed_processes_release_locks(tmp_path: Path) -> None:
    path = tmp_path / "cache.lock"
    with taking_turns(path), path.open() as other:
        assert not lock_descriptor(other.fileno(), blocking=False)
    code = f"""
import pathlib, time
from lerobot_memobench.jobs.processes import locked, taking_turns
path = pathlib.Path({str(path)!r})
with taking_turns(path), locked(path.parent, path.parent):
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
