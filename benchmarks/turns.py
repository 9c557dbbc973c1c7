"""Two sides of a comparison taking turns on a machine that may be busy with other things."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path

Side = Callable[[], object]


def medians(
    sides: Mapping[str, Side], repeats: int, warm_up: int = 1, clock: Callable[[], float] = time.process_time
) -> dict[str, float]:
    """Return the median seconds of each side; they take turns, in alternating order, so that load hits both.

    The clock counts this process's CPU seconds, all its threads together, because on a busy machine elapsed time says
    more about the others. Give ``time.perf_counter`` where the work is done elsewhere, as on a GPU.
    """
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    names = list(sides)
    for turn in range(repeats + warm_up):
        for name in names if turn % 2 else reversed(names):
            started = clock()
            sides[name]()
            if turn >= warm_up:
                seconds[name].append(clock() - started)
    return {name: statistics.median(values) for name, values in seconds.items()}


def resident() -> int:
    """Return the resident bytes of this process now."""
    return _status("VmRSS")


def reset_peak() -> None:
    """Let the peak begin again at what is resident now (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")


def peak() -> int:
    """Return the largest number of resident bytes since `reset_peak`."""
    return _status("VmHWM")


def _status(key: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024
    raise KeyError(key)
