"""Number of threads: one rule for every process of ours, and for the libraries in it.

A rollout is one step after another: a small policy, physics and both pictures take one core, and a second thread of
torch or of the renderer only waits busily for the next step. So a process that simulates has one thread of each, and
more cores mean more processes. Training, and a large policy that acts, multiply large matrices: they take all cores of
their process, shared among our processes on the same machine.

`use_threads` sets the environment before the libraries load; processes that are started later inherit it.
`limit_torch` sets torch's threads once a policy's size is known. Variables that a user has set stay.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

ACTING, LEARNING = "acting", "learning"
"""Roles of a process: simulate, draw and let a policy act; or train and encode."""
LARGE = 20_000_000
"""Parameters from which on a policy that acts is large: an action chunk of a smaller one takes a core some 50 ms."""

TORCH = "OMP_NUM_THREADS"
ONE_EACH = {"OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
"""Threads of numpy, for small matrices, and of llvmpipe, which draws without a GPU."""
SPINNING = {"GOMP_SPINCOUNT": "2000"}
"""How long torch's idle threads keep their core: milliseconds by default."""
CHOSEN_HERE = "MEMOBENCH_THREADS"
"""Variable with the names of those set by this rule: a child process may set them again, a user's own stay."""
BESIDE = "MEMOBENCH_PROCESSES"
"""Variable with the number of our processes, this one included, that share the cores."""

_CGROUPS = Path("/sys/fs/cgroup")


def cores() -> int:
    """Return how many cores this process may use: by affinity and by its container's quota, not by machine."""
    return max(1, min(len(_affinity()), _quota() or sys.maxsize))


def torch_threads(role: str, processes: int = 1, *, large: bool = False) -> int | None:
    """Return the threads of torch in each of so many processes on these cores; None: as torch itself chooses.

    Args:
        role: `ACTING` or `LEARNING`.
        processes: those of ours that share the cores.
        large: whether the policy that acts has `LARGE` parameters or more.
    """
    if role == ACTING and not large:
        return 1
    if role == LEARNING and processes == 1 and cores() == len(_affinity()):
        return None  # by affinity torch counts, too, and it leaves hyperthreads out
    return max(1, min(cores(), physical_cores()) // processes)


def use_threads(role: str) -> None:
    """Set this process's environment by the rule. Call it before numpy, torch or a renderer is loaded."""
    given = os.environ
    ours = set(filter(None, given.get(CHOSEN_HERE, "").split(",")))
    wanted = dict(ONE_EACH)
    if not {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & (given.keys() - ours) and role == ACTING:
        wanted |= SPINNING
    threads = torch_threads(role, processes_beside())
    if threads is not None:
        wanted[TORCH] = str(threads)
    chosen = {key: value for key, value in wanted.items() if key in ours or key not in given}
    for key in ours - chosen.keys():
        given.pop(key, None)
    given.update(chosen)
    given[CHOSEN_HERE] = ",".join(sorted(chosen))


def limit_torch(parameters: int) -> None:
    """Let torch, in a process where a policy of so many parameters acts, use the threads that the rule gives it."""
    if is_users_own(TORCH):
        return
    import torch

    threads = torch_threads(ACTING, processes_beside(), large=parameters >= LARGE)
    if threads is not None and threads != torch.get_num_threads():
        torch.set_num_threads(threads)


def is_users_own(variable: str) -> bool:
    """Return whether a user has set a variable of the environment, rather than this rule."""
    return variable in os.environ and variable not in os.environ.get(CHOSEN_HERE, "").split(",")


def processes_beside() -> int:
    """Return how many processes of ours share the cores of this one, itself included."""
    text = os.environ.get(BESIDE, "")
    return int(text) if text.isdecimal() and int(text) else 1


def sharing(processes: int, environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the environment of one of so many processes of ours that are started at once."""
    return {**(os.environ if environment is None else environment), BESIDE: str(processes)}


def _affinity() -> set[int]:
    """Return the numbers of the processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return set(range(os.cpu_count() or 1))


def physical_cores() -> int:
    """Return how many cores the processors of this process belong to."""
    found = set()
    for number in _affinity():
        path = Path(f"/sys/devices/system/cpu/cpu{number}/topology/thread_siblings_list")
        try:
            found.add(path.read_text())
        except OSError:
            found.add(str(number))
    return len(found)


def cpu_model() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _quota() -> int | None:
    """Return the whole cores that the container of this process may use, None where nothing limits it."""
    quotas = []
    try:
        own = [line.split(":", 2) for line in Path("/proc/self/cgroup").read_text().splitlines()]
    except OSError:
        return None
    for _, controllers, place in own:
        if controllers and "cpu" not in controllers.split(","):
            continue
        base = _CGROUPS / "cpu" if controllers else _CGROUPS
        folder = base / place.strip("/")
        # A limit above counts as well; in a container the place may be the host's, and its own limit lies at the top.
        for here in (folder, *folder.parents) if folder.is_relative_to(base) else (base,):
            quotas += _quota_in(here)
            if here == base:
                break
    return max(1, int(min(quotas))) if quotas else None


def _quota_in(folder: Path) -> list[float]:
    """Return the limit that one control group sets, cores; [] where it sets none."""
    try:
        if (folder / "cpu.max").is_file():
            quota, period = (folder / "cpu.max").read_text().split()
        else:
            quota, period = ((folder / f"cpu.cfs_{name}_us").read_text().strip() for name in ("quota", "period"))
        return [int(quota) / int(period)] if quota.isdecimal() and int(period) else []
    except (OSError, ValueError):
        return []
