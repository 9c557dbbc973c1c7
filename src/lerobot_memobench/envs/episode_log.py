"""The episode log of an evaluation: one JSON line per finished rollout, with its outcome.

Each process appends to a file of its own, ``<dir>/episodes/<task>.<pid>.jsonl``, so workers never wait for one another
and a killed run loses at most the line being written. `read_log` merges the files, and joins each line with the facts
that all lines share: settings, inputs and policy of the evaluation's file (`evaluation_file`).
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NotRequired, TypedDict

from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, EXTENT, POLICY, read_evaluation, write_facts
from lerobot_memobench.envs.settings import INTACT, steps_per_action
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.io import file_name, write_file
from lerobot_memobench.tasks.assessment import chance, classify_failure
from lerobot_memobench.tasks.catalogue import group_of, suite_of
from lerobot_memobench.tasks.task import REFERENTS, STRICT, Task
from lerobot_memobench.untrusted import Count, Malformed, Name, Number, Whole, checked, file_bytes, packed, parsed

if TYPE_CHECKING:
    from lerobot_memobench.envs.episode import Episode

logger = logging.getLogger(__name__)

EPISODES_FOLDER = "episodes"
MERGED_FILE = "episodes.jsonl"
WRITTEN_AT = "written_at"
"""Key in the workers' files only: time of writing, s since 1970. The newest of several lines counts."""

Key = tuple[str, int]  # identity of an episode in its evaluation: task and number

# --- lines ---


class CheckpointRecord(TypedDict):
    """A memory checkpoint of a rollout. Execution steps count from 1; None if the predicate never held."""

    operation: Literal["S", "U", "C"]  # Storage, Update or Compression
    first_step: Count | None  # first execution step at which it held
    # first execution step at which it held with all earlier checkpoints complete
    ordered_step: NotRequired[Count | None]


class EpisodeRecord(TypedDict):
    """A line of the log."""

    __pydantic_config__ = {"extra": "forbid"}  # type: ignore[misc]  # a line that states settings is of another format

    task: Name  # name in the catalogue
    memory_type: Name  # temporal, spatial, object or procedural; the suite of a task of LIBERO
    episode: Whole  # number of the episode in its evaluation, from 0
    seed: NotRequired[Whole | None]  # seed of the scene: seed base + episode, except in evidence episodes
    variant: NotRequired[Count | None]  # index of the task's variant; 0 is the published one
    prompt_steps: NotRequired[Count | None]  # control steps before the execution
    prompt_shown: NotRequired[bool | None]  # whether the demonstration prompt succeeded; None without a prompt
    steps: NotRequired[Count | None]  # execution steps
    paused_steps: NotRequired[Whole]  # control steps of pauses; only with pauses
    held_steps: NotRequired[Whole]  # control steps of holds; strict tasks only
    corrupted: NotRequired[bool]  # whether the memory was corrupted before the episode ended; only with corruption
    success: bool  # whether the goal held at the end
    choice: NotRequired[Count | None]  # evidence episodes: variant that the policy acted on; None for no variant
    # evidence episodes: whether the policy gave an answer. A wrong answer may fit no variant
    answered: NotRequired[bool]
    variants: NotRequired[Count]  # evidence episodes: number of variants of the task
    # evidence episodes: rate of correct choices without memory; None if the instruction names the variant
    chance: NotRequired[Number | None]
    checkpoints: list[CheckpointRecord]  # memory checkpoints in the task's order
    failure: NotRequired[Name | None]  # failure class; None for a success
    fault: NotRequired[str]  # reason why the episode was aborted: an invalid action or unstable physics
    lost: NotRequired[bool]  # strict tasks: whether the goal became unreachable
    stand_ins: NotRequired[list[Name]]  # classes whose missing scans this package's objects replaced
    scene_hash: NotRequired[Name | None]  # hash of the initial scene
    settled: NotRequired[bool]  # false if an object was thrown, or still moved, when the scene began; absent otherwise
    wall_s: NotRequired[Number | None]  # duration of the episode, s
    not_run: NotRequired[str]  # reason why the episode could not be run. Such a line is no rollout and enters no rate
    written_at: NotRequired[Number]  # time of writing, s since 1970; in the workers' files only


def episode_record(episode: Episode, number: int, wall_s: float) -> dict[str, Any]:
    """Return the log line of an episode, an `EpisodeRecord`; ``number``: its field ``episode``."""
    progress, task, fault, choice = episode.progress, episode.task, episode.fault, episode.choice
    failure = classify_failure(
        *(task, progress.first_step, episode.success, episode.drifted),
        lost=progress.broken if episode.lost else None,
        cut_off=episode.cut_off,
        ordered=progress.ordered,
    )
    steps = zip(task.checkpoints, progress.first_step, progress.ordered_step, strict=True)
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": number,
        "seed": episode.seed,
        "variant": task.variant_index,
        "prompt_steps": episode.exec_start if episode.exec_start is not None else episode.step_index,
        "prompt_shown": episode.prompt_shown,
        "steps": episode.exec_steps,
        **({"paused_steps": episode.pacing.paused_steps} if episode.pacing.pauses else {}),
        **({} if episode.settings.corrupt == INTACT else {"corrupted": episode.corrupted}),
        "success": episode.success,
        **({} if choice is None else evidence_line(task, choice.variant, choice.answered)),
        "checkpoints": [
            {"operation": checkpoint.operation, "first_step": first, "ordered_step": ordered}
            for checkpoint, first, ordered in steps
        ],
        "failure": failure if fault is None else fault.failure,
        **({} if fault is None else {"fault": fault.why}),
        **({"lost": episode.lost, "held_steps": episode.pacing.held_steps} if task.suite == STRICT else {}),
        "stand_ins": list(episode.stand_ins),
        "scene_hash": episode.scene_hash,
        **({} if episode.sim.settled else {"settled": False}),
        "wall_s": round(wall_s, 3),
    }


def evidence_line(task: Task, choice: int | None, answered: bool) -> dict[str, Any]:
    """Return the fields of an evidence episode's line that describe the choice among a task's variants."""
    return {"choice": choice, "answered": answered, "variants": len(task.random_variants), "chance": chance(task)}


def not_run_record(task: Task, number: int, seed: int, why: str, variants: int | None = None) -> dict[str, Any]:
    """Return the log line of an episode that could not be run; arguments are fields of `EpisodeRecord`."""
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": number,
        "seed": seed,
        "success": False,
        **({} if variants is None else {"variants": variants}),
        "checkpoints": [],
        "not_run": why,
    }


def key_of(record: Mapping[str, Any]) -> Key:
    """Return the identity of an episode in its evaluation."""
    return record["task"], record["episode"]


def seed_base(record: Mapping[str, Any]) -> int:
    """Return the seed of episode 0, computed from a rollout's own; a scene may be run with each of its variants."""
    return int(record["seed"]) - int(record["episode"]) // int(record.get("variants") or 1)


# --- writing ---


class EpisodeLog:
    """Append finished rollouts of this process to ``directory``, which is created when the first rollout ends.

    ``facts``: content of the evaluation's file, which is written before the first line; None if it is there.
    """

    def __init__(self, directory: str | Path, facts: Mapping[str, Any] | None = None) -> None:
        self.directory = Path(directory)
        self._facts = facts

    def append(self, record: Mapping[str, Any]) -> Path:
        """Write one rollout durably and return its file; refuse a folder with episodes of another protocol."""
        task = file_name(record["task"], "the task of a record of an episode")
        # The process id is not read earlier, because a log may be constructed before a fork.
        path = self.directory / EPISODES_FOLDER / f"{task}.{os.getpid()}.jsonl"
        try:
            line = json.dumps({**record, WRITTEN_AT: time.time()}, allow_nan=False).encode() + b"\n"
        except (TypeError, ValueError) as error:
            raise MemobenchError(
                f"the record of {record['task']!r} cannot be written as JSON ({error}); expected plain "
                "numbers, strings, lists and None"
            ) from error
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if self._facts is not None:
                write_facts(self.directory, self._facts)
                self._facts = None
            with path.open("ab+") as file:
                if _ends_torn(file):  # left by a killed process with the same id
                    line = b"\n" + line
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise MemobenchError(
                f"the episode log {path} cannot be written ({error.strerror or error}); choose another "
                "folder with --env.log_dir"
            ) from error
        return path


def _ends_torn(file: Any) -> bool:
    if file.seek(0, os.SEEK_END) == 0:
        return False
    file.seek(-1, os.SEEK_END)
    return bool(file.read(1) != b"\n")


def write_episodes(directory: str | Path, records: Iterable[Mapping[str, Any]]) -> Path:
    """Add the missing lines of ``records`` to ``<directory>/episodes.jsonl`` atomically and return its path.

    Existing lines stay unchanged, including unreadable ones, but for those of episodes that were not run and now are.
    Readers use the last line of an episode.
    """
    path = Path(directory) / MERGED_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    before = [*_read_file(path, [])] if path.is_file() else []
    logged = _newest(before)
    new = [line for line in map(line_of, records) if logged.get(key_of(line)) != line]
    run = {key_of(line) for line in (*before, *new) if "not_run" not in line}
    stale = {log_text([line]).encode() for line in before if "not_run" in line and key_of(line) in run}
    if new or stale or not path.is_file():
        content = path.read_bytes() if path.is_file() else b""
        content = b"".join(line for line in content.splitlines(keepends=True) if line not in stale)
        torn = b"\n" if content and not content.endswith(b"\n") else b""
        write_file(path, content + torn + log_text(new).encode())
    return path


def log_text(records: Iterable[Mapping[str, Any]]) -> str:
    """Return the lines of a log, without facts that they share."""
    return "".join(json.dumps(line_of(record)) + "\n" for record in records)


def line_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the line of a record: its outcome, without facts of the evaluation's file."""
    return {name: value for name, value in record.items() if name in EpisodeRecord.__annotations__}


# --- reading ---


def read_episodes(directory: str | Path) -> list[dict[str, Any]]:
    """Return the rollouts logged in ``directory``, see `read_log`."""
    return [record for record in read_log(directory) if "not_run" not in record]


def read_log(directory: str | Path) -> list[dict[str, Any]]:
    """Return all episodes logged in ``directory`` (`read_lines`), each with the facts of the evaluation's file."""
    lines = read_lines(directory)
    return joined(Path(directory), read_evaluation(Path(directory)), lines)


def joined(folder: Path, card: Mapping[str, Any], lines: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return lines with the facts of their evaluation's file: settings, inputs, and ``policy``, its identity.

    Refuse a line that no episode of these settings can have written.
    """
    facts = {name: value for name, value in card["protocol"].items() if name not in EXTENT}
    policy = card[POLICY].get("identity") or card[POLICY].get("type")
    facts |= {} if policy is None else {POLICY: policy}
    # Tasks of a user may have names of the catalogue; without settings it is unknown.
    own_tasks = card.get("settings", {"env": {"task_dir": ""}}).get("env", {}).get("task_dir") is not None
    records = [{**facts, **line} for line in lines]
    for record in records:
        if contradictions := [*_contradictions(record, own_tasks)]:
            raise MemobenchError(
                f"{folder}: {record['task']}, episode {record['episode']}, contradicts {EVALUATION_FILE} "
                f"({'; '.join(contradictions)}, in the file and in the log); restore both files, or evaluate again"
            )
    return records


def _contradictions(record: Mapping[str, Any], own_tasks: bool) -> Iterator[str]:
    # A line that contradicts its settings is of another evaluation, or was changed.
    base, evidence, pauses = record.get("seed_base"), record.get("evidence"), record.get("pause_steps")
    if None not in (base, record.get("seed")) and seed_base(record) != base:
        yield f"seed_base: {base} and {seed_base(record)}"
    longest = (record.get("horizon") or math.inf) * steps_per_action(record.get("speed") or 1.0)
    if (record.get("steps") or 0) > longest:
        yield f"steps: at most {longest} and {record['steps']}"
    if record.get("referent") == REFERENTS[0] and not evidence and record.get("variant"):
        yield f"variant: 0 and {record['variant']}"
    of_settings = {
        **dict.fromkeys(("choice", "answered", "variants", "chance"), evidence),
        **dict.fromkeys(("lost", "held_steps"), record.get("suite") == STRICT),
        **{"paused_steps": pauses, "corrupted": record.get("corrupt", INTACT) != INTACT},
    }
    extra = [name for name, allowed in of_settings.items() if name in record and not allowed]
    yield from (f"{name}: absent and {record[name]}" for name in extra)
    if "not_run" not in record:
        needed = {"choice": evidence, "paused_steps": pauses}
        absent = [name for name, required in needed.items() if required and name not in record]
        yield from (f"{name}: recorded and absent" for name in absent)
    if suite_of(record["task"]) is not None and not own_tasks:
        memory_type = group_of(record["task"])
        if memory_type != record["memory_type"]:
            yield f"memory_type: {memory_type} and {record['memory_type']}"


def read_lines(directory: str | Path, problems: list[str] | None = None) -> list[dict[str, Any]]:
    """Return all lines logged in ``directory``, sorted by task and episode, including episodes not run.

    Reads the workers' files and ``episodes.jsonl``, which may be compressed by ``gzip``. The newest line of an episode
    counts; *not run* counts only without a rollout. Unreadable lines, such as the last line of a killed run, are
    skipped. They are added to ``problems`` (file, line, reason), or logged as warnings without it, as are episodes with
    lines of both outcomes. Raise without a log.
    """
    directory = Path(directory)
    files = _log_files(directory)
    if not files:
        raise _without_log(directory)
    faults: list[str] = []
    lines = [line for file in files for line in _read_file(file, faults)]
    newest = _newest(lines)
    outcomes = {(key_of(line), line["success"]) for line in lines if "not_run" not in line}
    if twice := sorted(key for key in newest if {(key, True), (key, False)} <= outcomes):
        faults.append(
            f"{directory} has lines of success and of failure about {count_of(len(twice), 'episode')}, the first is "
            f"{twice[0][0]}, episode {twice[0][1]}; the newest line of each counts"
        )
    if problems is not None:
        problems += faults
    else:
        for fault in faults:
            logger.warning("%s", fault)
    return [{name: value for name, value in newest[key].items() if name != WRITTEN_AT} for key in sorted(newest)]


def _newest(lines: Iterable[dict[str, Any]]) -> dict[Key, dict[str, Any]]:
    # Stable: of equal times, the last file counts.
    by_time = sorted(lines, key=lambda line: ("not_run" not in line, line.get(WRITTEN_AT, 0.0)))
    return {key_of(line): line for line in by_time}


def _without_log(directory: Path) -> MemobenchError:
    if not directory.is_dir():
        hint = f", such as {directory.parent}" if directory.is_file() and _log_files(directory.parent) else ""
        return MemobenchError(f"{directory} is not a folder; expected one that an evaluation has written{hint}")
    if (directory / "meta" / "info.json").is_file():
        return MemobenchError(
            f"{directory} is a LeRobotDataset, expected the folder of an evaluation; read it by `memobench describe`"
        )
    nested = (file for depth in ("*", "*/*") for file in sorted(directory.glob(f"{depth}/{MERGED_FILE}*")))
    first = next(nested, None)
    return MemobenchError(
        f"{directory} holds no episode log; expected {MERGED_FILE} or {EPISODES_FOLDER}/*.jsonl, as an "
        f"evaluation writes them{'' if first is None else f'; there is one in {first.parent}'}"
    )


def not_run(records: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Return task -> its episodes that could not be run."""
    by_task: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        if "not_run" in record:
            by_task.setdefault(record["task"], []).append(record)
    return by_task


def notes_on_not_run(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one sentence per task with episodes that could not be run; it contains the first reason."""
    notes = []
    for task, lines in not_run(records).items():
        whole_task = len(lines) == sum(record["task"] == task for record in records)
        part = "was not run" if whole_task else f"was not run in {count_of(len(lines), 'episode')}"
        notes.append(f"{task} {part}, and the figures are without that: {lines[0]['not_run']}")
    return notes


def has_log(directory: Path) -> bool:
    """Return whether ``directory`` contains rollouts of an evaluation."""
    return bool(_log_files(directory))


def is_archive(directory: Path) -> bool:
    """Return whether the log in ``directory`` is a single compressed file, which is read-only."""
    return _log_files(directory) == [packed(directory / MERGED_FILE)]


def _log_files(directory: Path) -> list[Path]:
    # The merged file is first: its lines have no time, so lines of the workers' files replace them.
    merged = directory / MERGED_FILE
    whole = [path for path in (packed(merged), merged) if path.is_file()]
    return whole + sorted((directory / EPISODES_FOLDER).glob("*.jsonl"))


def _read_file(file: Path, problems: list[str]) -> Iterator[dict[str, Any]]:
    try:
        content = file_bytes(file)
    except OSError as error:
        problems.append(f"{file} cannot be read ({error.strerror or error}); left out")
        return
    for number, line in enumerate(content.split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            record = parsed(line)
        except Malformed:
            problems.append(f"{file}, line {number}: not a whole JSON line (was the run killed?); left out")
            continue
        try:
            yield checked(record, EpisodeRecord)
        except Malformed as error:
            problems.append(f"{file}, line {number}: {error}; left out")
