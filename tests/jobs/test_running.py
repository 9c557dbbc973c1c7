"""Independent pieces of work: run, found finished again, told of once each."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import dill
import pytest
from filelock import lock_descriptor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.executors import (
    Datatrove,
    Needs,
    asked_for,
    check_executor,
    options_text,
    read_options,
    run_jobs,
)
from lerobot_memobench.jobs.processes import Advance, locked, taking_turns
from tests.support.note_job import Killed, Note

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


@pytest.mark.parametrize(
    ("executor", "options"),
    [
        ("processes", {}),
        pytest.param("local", {}, marks=needs_datatrove),
        pytest.param(
            "ray",
            {"mem_per_cpu_gb": 1},
            marks=[pytest.mark.slow, pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")],
        ),
    ],
)
def test_a_killed_worker_ends_in_a_sentence(
    executor: str, options: dict[str, int], jobs: list[Note], tmp_path: Path
) -> None:
    if executor == "ray":
        import ray

        ray.init(num_cpus=2, include_dashboard=False, logging_level="ERROR", object_store_memory=80_000_000)
    try:
        killed = [jobs[0], Killed(jobs[1].folder, 1), *jobs[2:]]
        with pytest.raises(MemobenchError, match=r"worker processes was killed|1 of 4 jobs ended without a result"):
            run_jobs(killed, workers=2, executor=executor, options=options, logs=tmp_path / "logs", jobs_per_rank=1)
    finally:
        if executor == "ray":
            ray.shutdown()


@needs_datatrove
def test_a_datatrove_rank_takes_neighbours_and_can_be_pickled(jobs: list[Note]) -> None:
    from lerobot_memobench.jobs.datatrove_steps import JobsStep

    step = dill.loads(dill.dumps(JobsStep(jobs)))  # noqa: S301 - pickled in this line
    list(step.run(rank=1, world_size=2))
    assert [job.finished() for job in jobs] == [False, False, True, True]


@needs_datatrove
def test_words_for_sbatch_are_handed_on_and_false_is_false() -> None:
    from datatrove.executor import SlurmPipelineExecutor

    words = ["partition=gpu", "time=08:00:00", "account=lab", "gres=gpu:a100:1", "requeue=false", "srun_args.mpi=none"]
    words += ["sbatch_args.exclusive=true", "sbatch_args.mail-type=END", "requeue_signals=SIGUSR1,SIGTERM", "nice=0"]
    options = read_options(words)
    check_executor("slurm", options)
    told = options_text("slurm", options, Needs(cores=2, memory_gb=9, gpus=1))
    making = Datatrove("slurm", 1, Path("logs"), 1, told).arguments
    assert making["sbatch_args"] == {
        "account": "lab",
        "gres": "gpu:a100:1",
        "exclusive": "",
        "mail-type": "END",
        "nice": "0",
        "kill-on-invalid-dep": "yes",
    }
    assert making["srun_args"] == {"mpi": "none"}
    assert making["requeue"] is False
    assert making["requeue_signals"] == ("SIGUSR1", "SIGTERM")
    asked = SlurmPipelineExecutor([], tasks=1, **making).get_sbatch_args()
    assert (asked["cpus-per-task"], asked["mem-per-cpu"], asked["account"]) == (2, "5G", "lab")
    assert "gpus" not in asked  # gres= asks for it
    assert "requeue" not in asked
    assert "2 cores, 10 GB, account=lab, gres=gpu:a100:1" in asked_for(told)


def test_a_job_on_slurm_asks_for_what_it_needs_unless_told_otherwise() -> None:
    needs = Needs(cores=2, memory_gb=8, gpus=1)
    assert options_text("slurm", {}, needs) == {"cpus_per_task": 2, "mem_per_cpu_gb": 4, "gpus_per_task": 1}
    own = {"cpus_per_task": 8, "mem_per_cpu_gb": 3, "gpus_per_task": 0}
    assert options_text("slurm", own, needs) == own
    assert "8 cores, 24 GB, no GPU" in asked_for(own)
    assert options_text("local", {}, needs) == {}


@needs_datatrove
@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("requeue=maybe", "found requeue=maybe for executor 'slurm'; expected true or false"),
        ("cpus_per_task=many", "found cpus_per_task=many for executor 'slurm'; expected a whole number"),
        ("gpus_per_task=true", "expected a whole number"),
        ("acount=lab", "found option 'acount' for executor 'slurm', did you mean 'account'"),
        ("env.x=1", "found option 'env.x'"),
        ("sbatch_args=account", "found option 'sbatch_args'"),
    ],
)
def test_options_that_slurm_does_not_take(option: str, message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        check_executor("slurm", read_options(["partition=gpu", "time=1:00", option]))


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
from lerobot_memobench.jobs.processes import locked, taking_turns
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


def test_executor_options() -> None:
    assert read_options(["partition=cpu", "mem_per_cpu_gb=4", "env_command=a=b"]) == {
        "partition": "cpu",
        "mem_per_cpu_gb": 4,
        "env_command": "a=b",
    }
    told = read_options(["requeue=false", "with_srun=True", "condaenv=none", "qos="])
    assert told == {"requeue": False, "with_srun": True, "condaenv": None, "qos": ""}
    with pytest.raises(MemobenchError, match="expected key=value"):
        read_options(["partition"])
