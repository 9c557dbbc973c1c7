"""The episode log of an evaluation, one JSON line per finished rollout.

Each process appends to a file of its own, ``<dir>/episodes/<task>.<pid>.jsonl``, so workers never wait for one another
and a killed run loses at most the line being written. ``read_episodes`` merges them. The settings of the evaluation are
in another file, see `evaluation_file`.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NotRequired, TypedDict

from annotated_types import Ge, Le

from lerobot_memobench.envs.settings import GOALS, IDLE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import (
    Count,
    Malformed,
    Name,
    Number,
    Whole,
    checked,
    count_of,
    cut,
    file_bytes,
    file_name,
    packed,
    parsed,
    write_file,
)
from lerobot_memobench.protocol import BY_PAPER
from lerobot_memobench.tasks.evidence import chance
from lerobot_memobench.tasks.failures import classify_failure
from lerobot_memobench.tasks.task import MEMOBENCH, PUBLISHED, Task

if TYPE_CHECKING:
    from lerobot_memobench.envs.episode import Episode

logger = logging.getLogger(__name__)

EPISODES_FOLDER = "episodes"
MERGED_FILE = "episodes.jsonl"
WRITTEN_AT = "written_at"
"""In the workers' files only: when the line was written, s since 1970. It decides which of two lines is newer."""


# --- lines ---


class CheckpointRecord(TypedDict):
    """A memory checkpoint of a rollout. Execution steps are counted from 1; None: it never held.

    Attributes:
        operation: Storage, Update or Compression.
        first_step: execution step at which it held first.
        ordered_step: execution step at which it held first with all earlier ones complete.
    """

    operation: Literal["S", "U", "C"]
    first_step: Count | None
    ordered_step: NotRequired[Count | None]


class Outcome(TypedDict, total=False):
    """Fields of an episode that a log and a card share; logs of other tools leave some of them out.

    Attributes:
        seed: of the scene: seed base + episode, but where each scene is run with each variant.
        referent: fixed, random, or drawn (strict tasks).
        variant: which admissible referent or order; 0 is the published one.
        replan_steps: actions executed per prediction, where known.
        prompt_steps: control steps before the execution: of the demonstration prompt, and of idling.
        steps: execution steps.
        paused_steps: control steps of pauses, where there were to be some.
        choice: where each scene is run with each variant: which one was acted on; None: none of them.
        answered: whether an answer was given; False with a choice of None: none was.
        variants: then, of the task: how many there are to choose from.
        chance: then, of the task: the rate of right choices without the past; None where the instruction names it.
        failure: class of the failure; None for a success.
        suite: of tasks that are not published: strict.
        world: of scenes that are not the package's own: libero.
        stand_ins: of that world: classes whose scans were missing, so that others stood in for them.
        protocol: of the authors' evaluation: upstream.
        lost: of strict tasks: the goal could no longer be reached.
        fault: why the episode was broken off: an invalid action, unstable physics.
        scene_hash: hash of the initial scene.
    """

    seed: Whole | None
    referent: Name
    variant: Count | None
    replan_steps: Count | None
    prompt_steps: Count | None
    steps: Count | None
    paused_steps: Whole
    choice: Count | None
    answered: bool
    variants: Count
    chance: Number | None
    failure: Name | None
    suite: Name
    world: Name
    stand_ins: list[Name]
    protocol: Name
    lost: bool
    fault: str
    scene_hash: Name | None


class EpisodeRecord(Outcome):
    """A line, as it must be to count as a rollout (see `episode_record`).

    Attributes:
        task: name in the catalogue.
        memory_type: temporal, spatial, object or procedural.
        episode: its number.
        success: whether the goal held at the end.
        checkpoints: the memory checkpoints, in the task's order.
        prompt_shown: whether the demonstration prompt showed what it had to; None without one.
        wall_s: seconds that the episode took.
        not_run: why the episode could not be run: it is no rollout, and in no figure.
        policy: type and hash of the policy.
        run: which start of the evaluation.
        inputs: what the policy was given.
        written_at: when the line was written, s since 1970; in the workers' files alone.
    """

    task: Name
    memory_type: Name
    episode: Whole
    success: bool
    checkpoints: list[CheckpointRecord]
    prompt_shown: NotRequired[bool | None]
    wall_s: NotRequired[Number | None]
    not_run: NotRequired[str]
    policy: NotRequired[Name | None]
    run: NotRequired[Name | None]
    inputs: NotRequired[Name | None]
    written_at: NotRequired[Number]


def episode_record(episode: Episode, number: int, wall_s: float) -> dict[str, Any]:
    """Return an episode's line for the log (fields: `EpisodeRecord`).

    Args:
        number: of the episode in its evaluation, from 0 on.
        wall_s: seconds that the episode took.
    """
    progress, task, fault = episode.progress, episode.task, episode.fault
    failure = classify_failure(
        task, progress.first_step, episode.success, episode.drifted, lost=episode.lost, cut_off=episode.cut_off
    )
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": number,
        "seed": episode.seed,
        "referent": episode.referent,
        "variant": task.variant_index,
        "replan_steps": episode.settings.replan_steps,
        "prompt_steps": episode.exec_start if episode.exec_start is not None else episode.step_index,
        "prompt_shown": episode.prompt_shown,
        "steps": episode.exec_steps,
        **({"paused_steps": episode.pacing.paused_steps} if episode.pacing.pauses else {}),
        "success": episode.success,
        **({} if episode.choice is None else evidence_line(task, episode.choice.variant, episode.choice.answered)),
        "checkpoints": [
            {"operation": checkpoint.operation, "first_step": first, "ordered_step": ordered}
            for checkpoint, first, ordered in zip(
                task.checkpoints, progress.first_step, progress.ordered_step, strict=True
            )
        ],
        "failure": failure if fault is None else fault.failure,
        **({} if fault is None else {"fault": fault.why}),
        **({} if task.suite == PUBLISHED else {"suite": task.suite, "lost": episode.lost}),
        **({} if task.world == MEMOBENCH else {"world": task.world, "stand_ins": list(episode.stand_ins)}),
        **({} if episode.settings.protocol == BY_PAPER else {"protocol": episode.settings.protocol}),
        "scene_hash": episode.scene_hash,
        "wall_s": round(wall_s, 3),
    }


def evidence_line(task: Task, choice: int | None, answered: bool) -> dict[str, Any]:
    """Return the part of an episode's line about its choice among a task's variants."""
    return {"choice": choice, "answered": answered, "variants": len(task.random_variants), "chance": chance(task)}


def key_of(record: Mapping[str, Any]) -> tuple[str, int, str]:
    """Return the identity of an episode: task, number, referent."""
    return record["task"], record["episode"], record.get("referent", "fixed")


def not_run_record(
    task: Task, number: int, seed: int, referent: str, why: str, variants: int | None = None
) -> dict[str, Any]:
    """Return the line for the log of an episode that could not be run; arguments are fields of `EpisodeRecord`."""
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": number,
        "seed": seed,
        "referent": referent,
        "success": False,
        **({} if variants is None else {"variants": variants}),
        "checkpoints": [],
        **({} if task.suite == PUBLISHED else {"suite": task.suite}),
        **({} if task.world == MEMOBENCH else {"world": task.world}),
        "not_run": why,
    }


# --- writing ---


class EpisodeLog:
    """Appends finished rollouts of this process to ``directory``, which is made when the first one ends.

    Args:
        begin: called once, before the first line is written; it may refuse.
    """

    def __init__(self, directory: str | Path, begin: Callable[[], object] | None = None) -> None:
        self.directory = Path(directory)
        self._begin = begin

    def append(self, record: Mapping[str, Any]) -> Path:
        """Write one rollout to disk, for good when this returns; return the file it went to.

        The process is looked up here, not at construction: a log made before a fork is used after it.

        Raises:
            MemobenchError: the folder cannot be written or holds episodes of another protocol, the record is no JSON,
                or its task's name names no file.
        """
        task = file_name(record["task"], "the task of a record of an episode")
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
            if self._begin is not None:
                self._begin()
                self._begin = None
            with path.open("ab+") as file:
                if _ends_torn(file):  # a killed process with the same number was here before
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


def write_episodes(directory: str | Path, records: list[dict[str, Any]]) -> Path:
    """Add to ``<directory>/episodes.jsonl`` those of ``records`` that it lacks, whole or not at all; return its path.

    Lines that are there stay as they are, also unreadable ones. A line that is added replaces an earlier one about the
    same episode for readers.
    """
    path = Path(directory) / MERGED_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    there = {key_of(record): record for record in _read_lines(path, [])} if path.is_file() else {}
    lines = [json.dumps(record) + "\n" for record in records if there.get(key_of(record)) != record]
    if lines or not path.is_file():
        content = path.read_bytes() if path.is_file() else b""
        torn = b"\n" if content and not content.endswith(b"\n") else b""
        write_file(path, content + torn + "".join(lines).encode())
    return path


# --- reading ---


def read_episodes(directory: str | Path, problems: list[str] | None = None) -> list[dict[str, Any]]:
    """Return the rollouts logged under ``directory``, see `read_log`; ``problems`` names those that were not run."""
    records = read_log(directory, problems)
    if problems is not None:
        problems += notes_on_not_run(records)
    return [record for record in records if "not_run" not in record]


def not_run(records: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Return task -> those of its episodes that could not be run."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        if "not_run" in record:
            found.setdefault(record["task"], []).append(record)
    return found


def notes_on_not_run(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each task of which episodes could not be run, with the first of the reasons."""
    notes = []
    for task, lines in not_run(records).items():
        all_of_it = len(lines) == sum(record["task"] == task for record in records)
        part = "was not run" if all_of_it else f"was not run in {count_of(len(lines), 'episode')}"
        notes.append(f"{task} {part}, and the figures are without that: {lines[0]['not_run']}")
    return notes


def _log_below(directory: Path) -> str:
    """Return a hint at the first log in a folder's folders, or theirs; "" where there is none."""
    logs = (file for depth in ("*", "*/*") for file in sorted(directory.glob(f"{depth}/{MERGED_FILE}*")))
    first = next(logs, None)
    return "" if first is None else f"; there is one in {first.parent}"


def read_log(directory: str | Path, problems: list[str] | None = None) -> list[dict[str, Any]]:
    """Return all lines logged under ``directory``, sorted by task, episode and referent; also of episodes not run.

    Reads the workers' files and ``episodes.jsonl``, also as ``gzip`` compresses it; of several lines about the same
    task, episode and referent the newest counts. Lines that cannot be read, such as the last one of a killed run, are
    left out, named in ``problems`` (file, line, reason) and logged as warnings; so are episodes with lines of either
    outcome.

    Raises:
        MemobenchError: there is no such folder, no log in it, or one of several policies.
    """
    directory = Path(directory)
    if not directory.is_dir():
        hint = f", such as {directory.parent}" if directory.is_file() and _log_files(directory.parent) else ""
        raise MemobenchError(f"{directory} is not a folder; expected one that an evaluation has written{hint}")
    files = _log_files(directory)
    if not files:
        raise MemobenchError(
            f"{directory} holds no episode log; expected {MERGED_FILE} or {EPISODES_FOLDER}/*.jsonl, as an "
            f"evaluation writes them{_log_below(directory)}"
        )
    found: list[str] = []
    policies: dict[str | None, tuple[Path, dict[str, Any]]] = {}
    newest: dict[tuple[str, int, str], tuple[float, dict[str, Any]]] = {}
    outcomes: dict[tuple[str, int, str], set[bool]] = {}
    for file in files:
        for record in _read_lines(file, found):
            policies.setdefault(record.get("policy"), (file, record))
            written = float(record.pop(WRITTEN_AT, 0.0))
            key = key_of(record)
            if "not_run" not in record:
                outcomes.setdefault(key, set()).add(record["success"])
            if key not in newest or written >= newest[key][0]:
                newest[key] = (written, record)
    _check_one_policy(directory, policies)
    twice = sorted(key for key, told in outcomes.items() if len(told) > 1)
    if twice:
        found.append(
            f"{directory} has lines of success and of failure about {count_of(len(twice), 'episode')}, the first is "
            f"{twice[0][0]}, episode {twice[0][1]}; the newest line of each counts"
        )
    for problem in found:
        logger.warning("%s", problem)
    if problems is not None:
        problems += found
    return [newest[key][1] for key in sorted(newest)]


def _check_one_policy(directory: Path, policies: Mapping[str | None, tuple[Path, Mapping[str, Any]]]) -> None:
    """Refuse a log of several policies (identity -> a line of it and its file): rates would mix them."""
    known = [(name, *place) for name, place in policies.items() if name is not None]
    if len(known) > 1:
        told = " and ".join(f"{name} ({record['task']}, in {file.name})" for name, file, record in known[:2])
        raise MemobenchError(
            f"{directory} holds episodes of {len(known)} policies: {told}; they are not one evaluation. Evaluate each "
            "into a folder of its own, or sort the lines by their `policy` into such folders"
        )


def has_log(directory: Path) -> bool:
    """Return whether ``directory`` holds rollouts of an evaluation."""
    return bool(_log_files(directory))


def is_archive(directory: Path) -> bool:
    """Return whether the log in ``directory`` is a compressed one alone: it is kept, and only read."""
    return _log_files(directory) == [packed(directory / MERGED_FILE)]


def _log_files(directory: Path) -> list[Path]:
    """The merged file first: its lines carry no time, and those of the workers' files that do are newer."""
    merged = directory / MERGED_FILE
    whole = [path for path in (packed(merged), merged) if path.is_file()]
    return whole + sorted((directory / EPISODES_FOLDER).glob("*.jsonl"))


def _read_lines(file: Path, problems: list[str]) -> Iterator[dict[str, Any]]:
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


# --- the protocol ---


UNTOLD: dict[str, Any] = {
    **{"suite": PUBLISHED, "world": MEMOBENCH, "protocol": BY_PAPER},
    **{"pause_steps": 0, "speed": 1.0, "evidence": False, IDLE: 0, GOALS: 1, "render_every": 1},
}
"""Values of settings that a protocol leaves out: there were no others when it was written. ``render_every`` is a
setting of earlier versions: control steps per drawn picture."""
INPUTS = "inputs"
"""Inputs of the policy, in the words of `observations.policy_inputs`; absent in logs from before they were recorded."""
OF_THE_POLICY = ("prompt_in", INPUTS)
"""Settings that follow from the policy: evaluations of two policies may differ in them, which is told, parts of one may
not."""
EXTENT = ("tasks", "episodes")
"""How much was run: it may differ, the episodes in common still compare."""
POLICY = "policy"
MOST_EPISODES = 100_000
"""Of one task. Every episode that was asked for and is missing is counted, so a file must not ask for any number."""
Episodes = Annotated[int, Ge(0), Le(MOST_EPISODES)]


def differences(
    a: Mapping[str, Any],
    b: Mapping[str, Any],
    *,
    extent: bool = False,
    policy: bool = False,
    ignore: Collection[str] = (),
) -> list[str]:
    """Return the settings in which two protocols differ, each as ``horizon: 1200 and 600``.

    A setting that one of them does not tell (logs of other tools) is not a difference, but for `UNTOLD`.

    Args:
        extent: whether tasks and number of episodes are compared as well.
        policy: whether what is known of the policy is.
        ignore: settings that may differ.
    """
    left_out = {*ignore, POLICY, *(() if extent else EXTENT)}
    told = {**UNTOLD, **a}
    found = _differing({k: v for k, v in told.items() if k not in left_out}, {**UNTOLD, **b})
    if policy:
        found += _differing(a.get(POLICY) or {}, b.get(POLICY) or {}, f"{POLICY}.")
    return found


def _differing(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key, value in a.items():
        if key not in b or b[key] == value:
            continue
        other = b[key]
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            found += _differing(value, other, f"{prefix}{key}.")
        else:
            found.append(f"{cut(f'{prefix}{key}')}: {_text(value)} and {_text(other)}")
    return found


def _text(value: Any) -> str:
    if not isinstance(value, list):
        return cut(str(value))
    shown = ", ".join(cut(str(each)) for each in value[:3])
    return f"{shown}, … ({len(value)})" if len(value) > 3 else shown
