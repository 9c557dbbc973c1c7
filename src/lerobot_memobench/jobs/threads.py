"""Set the number of threads of this package's processes and their libraries.

A rollout is sequential: a second thread of torch or of the renderer only spins until the next step. So a process that
simulates has one thread of each, and more cores mean more processes. Training and large policies multiply large
matrices: they use all cores, shared among this package's processes. Variables of the user are kept.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from functools import cache
from pathlib import Path

ACTING, LEARNING = "acting", "learning"
"""Roles of a process: run rollouts, or train and encode."""
LARGE = 20_000_000
"""Number of parameters of a large policy. A smaller one computes an action chunk in some 50 ms on one core."""

TORCH = "OMP_NUM_THREADS"
ONE_EACH = {"OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
"""Threads of numpy, for small matrices, and of llvmpipe, which renders without a GPU."""
SPINNING = {"GOMP_SPINCOUNT": "2000"}
"""How long idle threads of torch spin; the default is milliseconds."""
CHOSEN_HERE = "MEMOBENCH_THREADS"
"""Variable with the names of the variables set here; child processes may change those, but not the user's."""
PROCESSES = "MEMOBENCH_PROCESSES"
"""Variable with the number of processes of this package that share the cores, including this one."""

_CGROUPS = Path("/sys/fs/cgroup")


def cores() -> int:
    """Return the number of cores that this process may use, by affinity and by its container's quota."""
    return max(1, min(len(_affinity()), _quota() or sys.maxsize))


def torch_threads(role: str, processes: int = 1, *, large: bool = False) -> int | None:
    """Return torch's threads in each of so many processes, for a policy of `LARGE` parameters or not; None: default."""
    if role == ACTING and not large:
        return 1
    if role == LEARNING and processes == 1 and cores() == len(_affinity()):
        return None  # torch's default uses affinity too, without hyperthreads
    siblings = set()  # hyperthreads of one physical core have the same list
    for number in _affinity():
        path = Path(f"/sys/devices/system/cpu/cpu{number}/topology/thread_siblings_list")
        try:
            siblings.add(path.read_text())
        except OSError:
            siblings.add(str(number))
    return max(1, min(cores(), len(siblings)) // processes)


def use_threads(role: str) -> None:
    """Set environment variables, which child processes inherit, before numpy, torch or a renderer is loaded."""
    environment = os.environ
    ours = set(filter(None, environment.get(CHOSEN_HERE, "").split(",")))
    wanted = dict(ONE_EACH)
    if not {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & (environment.keys() - ours) and role == ACTING:
        wanted |= SPINNING
    if (threads := torch_threads(role, sharing_processes())) is not None:
        wanted[TORCH] = str(threads)
    chosen = {key: value for key, value in wanted.items() if key in ours or key not in environment}
    for key in ours - chosen.keys():
        environment.pop(key, None)
    environment.update(chosen)
    environment[CHOSEN_HERE] = ",".join(sorted(chosen))


def limit_torch(parameters: int) -> None:
    """Set torch's threads in a process in which a policy of so many parameters acts."""
    if TORCH in os.environ and TORCH not in os.environ.get(CHOSEN_HERE, "").split(","):
        return  # the user has set it
    import torch

    threads = torch_threads(ACTING, sharing_processes(), large=parameters >= LARGE)
    if threads is not None and threads != torch.get_num_threads():
        torch.set_num_threads(threads)


def at_once[Result](calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """Return the results of calls that release the interpreter's lock, in two threads where a second core is free."""
    if len(calls) < 2 or not has_second_core():
        return [call() for call in calls]
    *others, last = calls
    running = [_second_thread(os.getpid()).submit(call) for call in others]
    try:
        result = last()
    finally:
        wait(running)
    return [*(future.result() for future in running), result]


@cache
def has_second_core() -> bool:
    """Return whether the process has two cores that it does not share with other processes of this package."""
    return multiprocessing.parent_process() is None and sharing_processes() == 1 and cores() > 1


@cache
def _second_thread(process: int) -> ThreadPoolExecutor:  # a forked process has no threads of its parent
    return ThreadPoolExecutor(1, f"second of {process}")


def sharing_processes() -> int:
    """Return the number of processes that share the cores of this one, including itself."""
    text = os.environ.get(PROCESSES, "")
    return int(text) if text.isdecimal() and int(text) else 1


def sharing(processes: int) -> dict[str, str]:
    """Return the environment of one of so many processes that share the cores."""
    return {**os.environ, PROCESSES: str(processes)}


def _affinity() -> set[int]:
    """Return the numbers of the processors that this process may run on."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def cpu_model() -> str:
    """Return the processor's name."""
    with suppress(OSError):  # platform.processor() names no model on Linux
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _quota() -> int | None:
    """Return the whole cores that the container of this process may use, None without a limit."""
    try:
        group_path = Path("/proc/self/cgroup").read_text().rpartition("::")[2].strip()  # of control groups, version 2
    except OSError:
        return None
    quotas, folder = [], _CGROUPS / group_path.strip("/")
    # Limits of outer groups count too. In a container the path may be the host's, with the limit at the top.
    for group in (folder, *folder.parents) if folder.is_relative_to(_CGROUPS) else (_CGROUPS,):
        with suppress(OSError, ValueError):
            quota, period = (group / "cpu.max").read_text().split()
            quotas += [int(quota) / int(period)] if quota.isdecimal() else []
        if group == _CGROUPS:
            break
    return max(1, int(min(quotas))) if quotas else None
