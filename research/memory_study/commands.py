"""Commands of the product, each run once: its output goes to a file, its words and its cost to another."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, NotRequired, TypedDict

from lerobot_memobench.commands.command_line import parse_words
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.jobs.threads import sharing
from lerobot_memobench.untrusted import read_json

MODULES = {"lerobot": "lerobot_memobench.cli.lerobot", "memobench": "lerobot_memobench.cli.memobench"}


@dataclass(frozen=True)
class Cost:
    """Time of a command over all its attempts: seconds of wall time, and CPU seconds of attempts that ended."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)


class Kept(TypedDict):
    """The file of a command.

    Attributes:
        words: the command. ended: whether it ended well. wall_s, cpu_s: see `Cost`.
        began: start of the attempt that runs, or was killed; seconds since 1970.
    """

    words: list[str]
    ended: bool
    wall_s: float
    cpu_s: float
    began: NotRequired[float]


def run_once(
    words: Sequence[str],
    log: Path,
    *,
    how: Sequence[str] = (),
    at_once: int = 1,
    accept: Sequence[int] = (0,),
    resume_by: Sequence[str] | None = None,
    makes: Path | None = None,
    proof: Path | None = None,
) -> Cost:
    """Run ``lerobot …`` or ``memobench …`` unless it has ended well before; return its cost.

    Args:
        log: file of its output; `Kept` goes to a JSON file of the same stem.
        how: more words that do not change the result, such as the number of processes.
        at_once: commands that run at the same time, this one included; they share the cores (`jobs.threads`).
        accept: exit statuses of a command that did its work.
        resume_by: command that resumes an earlier attempt.
        makes: folder that the command refuses to find. Without ``resume_by`` it is removed first.
        proof: file that shows that an accepted command did its work.
    """
    kept, spent = log.with_suffix(".json"), Cost(0.0, 0.0)
    if earlier := kept_of(log):
        if earlier["words"] != list(words):
            raise MemobenchError(
                f"{kept} is of another command; name another --out, or remove the file and the command's results"
            )
        spent = Cost(earlier["wall_s"], earlier["cpu_s"])
        if earlier["ended"]:
            return spent
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as output:
        try:
            fcntl.flock(output, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the command inherits the lock and holds it to its end
        except BlockingIOError:
            raise MemobenchError(f"an earlier command still writes {log}; wait for its end, or end it") from None
        if earlier and "began" in earlier:  # it was killed; its last output was just before
            spent += Cost(round(max(log.stat().st_mtime - earlier["began"], 0.0), 1), 0.0)
        if makes is not None and resume_by is None:
            shutil.rmtree(makes, ignore_errors=True)
        # Written first, so that a killed command is resumed by the same command alone.
        _keep(kept, words, False, spent, began=time.time())
        status, took = _run(resume_by or [*words, *how], output, sharing(at_once))
    well = status in accept and (proof is None or proof.exists())
    _keep(kept, words, well, spent + took)
    if not well:
        *_, last = log.read_text(errors="replace").rstrip().splitlines() or [""]
        raise MemobenchError(f"`{' '.join(words)}` ended with status {status} ({last[:400]}); see {log}")
    return spent + took


def _keep(kept: Path, words: Sequence[str], ended: bool, spent: Cost, **more: float) -> None:
    write_file(kept, json.dumps({"words": list(words), "ended": ended, **asdict(spent), **more}, indent=1))


def kept_of(log: Path) -> Kept | None:
    """Return the file of a log's command; None where the command has not been started."""
    try:
        kept: Kept = read_json(log.with_suffix(".json"), Kept, "remove it, and the command is run again")
    except FileNotFoundError:
        return None
    return kept


def has_ended(log: Path) -> bool:
    """Return whether the command of a log has ended well."""
    kept = kept_of(log)
    return kept is not None and kept["ended"]


def train_once(words: Sequence[str], log: Path, policy: Path, *, at_once: int = 1) -> Cost:
    """Run ``lerobot train …`` into the folder ``policy``, or resume its last checkpoint; see `run_once`."""
    from lerobot_memobench.training.command import TRAIN_CONFIG, last_checkpoint

    try:
        config = last_checkpoint(policy) / TRAIN_CONFIG
    except MemobenchError:
        return run_once(words, log, at_once=at_once, makes=policy)
    if kept_of(log) is None:
        raise MemobenchError(
            f"{policy} holds a checkpoint, but {log.with_suffix('.json')} with its command is missing; remove the "
            "folder to train again"
        )
    resume_by = ["lerobot", "train", f"config_path={config}", "resume=true"]
    return run_once(words, log, at_once=at_once, resume_by=resume_by)


def check_training(words: Sequence[str]) -> None:
    """Refuse invalid words of ``lerobot train …`` before it is run; its dataset need not exist yet."""
    from lerobot_memobench.commands.command_line import read_words
    from lerobot_memobench.training.command import take_training_options

    *_, rest = take_training_options(parse_words([word for word in words[2:] if not word.startswith("dataset=")]))
    read_words("train", {**rest, "dataset.repo_id": "none"}).build()


def _run(words: Sequence[str], output: IO[str], environment: Mapping[str, str]) -> tuple[int, Cost]:
    """Run a command to its end; return its exit status and the cost of the command and its own processes."""
    started = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", MODULES[words[0]], *words[1:]],
        stdout=output,
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
