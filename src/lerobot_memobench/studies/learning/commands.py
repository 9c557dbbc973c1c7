"""A command of ours, run as a user would, its output in a file and its cost known."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import read_json, write_file
from lerobot_memobench.jobs.threads import sharing

MODULES = {"lerobot": "lerobot_memobench.cli.lerobot", "memobench": "lerobot_memobench.cli.memobench"}


@dataclass(frozen=True)
class Cost:
    """What a command took: seconds on the clock and of processors, over all its attempts."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: Cost) -> Cost:
        """Return both together."""
        return Cost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)


def run_once(
    words: Sequence[str],
    log: Path,
    *,
    how: Sequence[str] = (),
    beside: int = 1,
    accept: Sequence[int] = (0,),
    going_on: Sequence[str] | None = None,
) -> Cost:
    """Run ``lerobot …`` or ``memobench …`` unless it has ended well before; return what it took.

    Its output goes to ``log``, its cost and its words beside it.

    Args:
        how: more words, which decide nothing that comes out: in how many processes it is done.
        beside: commands that run at once, this one included; they share the cores (`jobs.threads`).
        accept: exit statuses of a command that did its work.
        going_on: what is run instead, to finish what an earlier attempt has begun.

    Raises:
        MemobenchError: the command failed, or another one stands beside the log.
    """
    kept = log.with_suffix(".json")
    spent = Cost(0.0, 0.0)
    if kept.is_file():
        told = read_json(kept, dict[str, object], "remove it, and the command is run again")
        if told.get("words") != list(words):
            raise MemobenchError(f"{kept} is of another command; name another --out, or remove the file")
        spent = Cost(float(str(told["wall_s"])), float(str(told["cpu_s"])))
        if told["ended"]:
            return spent
    log.parent.mkdir(parents=True, exist_ok=True)
    status, took = _run(going_on or [*words, *how], log, sharing(beside))
    spent, ended = spent + took, status in accept
    write_file(kept, json.dumps({"words": list(words), "ended": ended, **asdict(spent)}, indent=1))
    if not ended:
        *_, last = log.read_text(errors="replace").rstrip().splitlines() or [""]
        raise MemobenchError(f"`{' '.join(words)}` ended with status {status} ({last[:400]}); see {log}")
    return spent


def _run(words: Sequence[str], log: Path, environment: Mapping[str, str]) -> tuple[int, Cost]:
    """Run a command to its end; return its exit status and what it and its own processes took."""
    started = time.monotonic()
    with log.open("a") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", MODULES[words[0]], *words[1:]],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
        )
        try:
            _, status, used = os.wait4(process.pid, 0)
        except BaseException:
            process.terminate()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.monotonic() - started
    return process.returncode, Cost(round(wall, 1), round(used.ru_utime + used.ru_stime, 1))
