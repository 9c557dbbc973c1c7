"""Numbers of threads on imitated machines of 2 and 16 cores."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from lerobot_memobench.jobs import threads
from lerobot_memobench.jobs.threads import ACTING, LARGE, LEARNING, PROCESSES, cores, limit_torch, torch_threads


class Machine:
    """Imitate processors, hyperthreads and a container's quota."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        self.monkeypatch, self.folder = monkeypatch, tmp_path

    def has(self, processors: int, quota: str | None = None, hyperthreads: int = 1) -> None:
        self.monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(processors)))
        self.monkeypatch.setattr(os, "cpu_count", lambda: 128)
        self.monkeypatch.setattr(threads, "_CGROUPS", self.folder)
        (self.folder / "cpu.max").write_text(quota or "max 100000\n")
        read = Path.read_text

        def text(path: Path, *args: Any, **settings: Any) -> str:
            if path == Path("/proc/self/cgroup"):
                return "0::/\n"
            if path.name == "thread_siblings_list":
                return str(int(path.parts[-3].removeprefix("cpu")) // hyperthreads)
            return read(path, *args, **settings)

        self.monkeypatch.setattr(Path, "read_text", text)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Machine:
    return Machine(monkeypatch, tmp_path)


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    found = {"HOME": "/nowhere"}
    monkeypatch.setattr(os, "environ", found)
    return found


def test_cores_are_those_of_this_process(machine: Machine) -> None:
    machine.has(16)
    assert cores() == 16
    machine.has(16, quota="350000 100000")
    assert cores() == 3
    machine.has(16, quota="50000 100000")
    assert cores() == 1
    machine.has(2, quota="800000 100000")
    assert cores() == 2


def test_limits_of_outer_groups_count(machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine.has(16)
    read = Path.read_text
    place = tmp_path / "job_1" / "step_0"
    place.mkdir(parents=True)
    (place / "cpu.max").write_text("800000 100000")
    (tmp_path / "job_1" / "cpu.max").write_text("400000 100000")
    monkeypatch.setattr(Path, "read_text", lambda path: "0::/job_1/step_0\n" if path.name == "cgroup" else read(path))
    assert cores() == 4


@pytest.mark.parametrize(
    ("processors", "role", "large", "processes", "threads_of_torch"),
    [
        (2, ACTING, False, 1, 1),  # a small policy: one process, one core
        (16, ACTING, False, 8, 1),  # parts of an evaluation
        (16, ACTING, True, 4, 4),
        (2, ACTING, True, 4, 1),
        (2, LEARNING, False, 1, None),  # torch's own choice
        (16, LEARNING, False, 4, 4),  # policies trained at once
    ],
)
def test_threads_of_each_role(
    machine: Machine, processors: int, role: str, large: bool, processes: int, threads_of_torch: int | None
) -> None:
    machine.has(processors)
    assert torch_threads(role, processes, large=large) == threads_of_torch


def test_hyperthreads_and_quotas(machine: Machine) -> None:
    machine.has(16, hyperthreads=2)
    assert torch_threads(ACTING, large=True) == 8
    machine.has(16, quota="400000 100000")
    assert torch_threads(ACTING, large=True) == 4
    assert torch_threads(LEARNING) == 4  # torch would see 16


@pytest.mark.parametrize("role", [ACTING, LEARNING])
def test_variables_of_the_user_stay(machine: Machine, environment: dict[str, str], role: str) -> None:
    machine.has(16)
    own = {"OMP_NUM_THREADS": "7", "LP_NUM_THREADS": "4", "OPENBLAS_NUM_THREADS": "3", "OMP_WAIT_POLICY": "active"}
    environment.update(own)
    for _ in range(2):  # in this process, and in one that it starts
        threads.use_threads(role)
        assert {key: environment[key] for key in own} == own
        assert "GOMP_SPINCOUNT" not in environment
    before = torch.get_num_threads()
    limit_torch(2 * LARGE)
    assert torch.get_num_threads() == before


COMMAND = """
from lerobot_memobench.cli.memobench import main
main(["tasks", "--help"])
import torch, os
print(torch.get_num_threads(), os.environ["OPENBLAS_NUM_THREADS"], os.environ["LP_NUM_THREADS"])
"""
WORKER = """
from lerobot_memobench.jobs.processes import process_pool
from asked import ask
if __name__ == "__main__":
    with process_pool(1) as pool:
        print(*pool.submit(ask).result())
"""
ASKED = """
def ask():
    import torch, os
    return torch.get_num_threads(), os.environ["LP_NUM_THREADS"], os.environ["MEMOBENCH_WORKER"]
"""


def test_large_policies_get_more_threads(machine: Machine, environment: dict[str, str]) -> None:
    machine.has(16)
    threads.use_threads(ACTING)
    before = torch.get_num_threads()
    try:
        for parameters, processes, found in ((LARGE, 1, 16), (LARGE - 1, 1, 1), (LARGE, 8, 2)):
            environment[PROCESSES] = str(processes)
            limit_torch(parameters)
            assert torch.get_num_threads() == found
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("program", [COMMAND, WORKER], ids=["command", "worker"])
def test_threads_are_set_before_libraries_load(program: str, tmp_path: Path) -> None:
    clean = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    (tmp_path / "asked.py").write_text(ASKED)
    (tmp_path / "program.py").write_text(program)
    words = [sys.executable, str(tmp_path / "program.py")]
    done = subprocess.run(words, env=clean, capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.splitlines()[-1] == "1 1 1"


@pytest.mark.parametrize("second_core", [True, False])
def test_an_error_of_one_of_several_calls(monkeypatch: pytest.MonkeyPatch, second_core: bool) -> None:
    monkeypatch.setattr(threads, "has_second_core", lambda: second_core)
    assert threads.at_once([lambda: 1, lambda: 2, lambda: 3]) == [1, 2, 3]
    for calls in ([lambda: 1 // 0, lambda: 2], [lambda: 1, lambda: 1 // 0]):
        with pytest.raises(ZeroDivisionError):
            threads.at_once(calls)
