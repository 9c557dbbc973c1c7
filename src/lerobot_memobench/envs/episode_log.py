"""The episode log of an evaluation: one JSON line per finished rollout.

Each process appends to a file of its own, ``<dir>/episodes/<task>.<pid>.jsonl``, so workers never wait for one another
and a killed run loses at most the line being written. `read_episodes` merges the files. `evaluation_file` holds the
settings of the evaluation.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NotRequired, TypedDict

from annotated_types import Ge, Le

from lerobot_memobench.envs.settings import GOALS, HOLD, MEMORY_CONTROLS, PICTURES, SCENE_HASHES
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
from lerobot_memobench.sim.scene_hash import FORMER, LIBERO, WORLD
from lerobot_memobench.tasks.evidence import chance
from lerobot_memobench.tasks.failures import classify_failure
from lerobot_memobench.tasks.task import PUBLISHED, STANDARD, STRICT, Difficulty, Task

if TYPE_CHECKING:
    from lerobot_memobench.envs.episode import Episode

logger = logging.getLogger(__name__)

EPISODES_FOLDER = "episodes"
MERGED_FILE = "episodes.jsonl"
WRITTEN_AT = "written_at"
"""Key in the workers' files only: time of writing, s since 1970. The newest of several lines counts."""
INPUTS = "inputs"
"""Key of the policy's inputs, see `observations.policy_inputs`; absent in older logs."""
POLICY = "policy"


@dataclass(frozen=True)
class Acting:
    """The policy of an evaluation, as the log names it. It is unknown in gymnasium and in LeRobot's trainings.

    Attributes:
        policy: ``type``, ``identity`` and, for a checkpoint in a folder, ``sha256``; {} if unknown.
        inputs: inputs of the policy in words; None if unknown.
        run: name of this start of the evaluation; a log may hold several starts of one policy.
        seeds: seeds of the requested episodes; None if unknown. Whole batches are run, so there may be other
            episodes, which are not logged.
    """

    policy: Mapping[str, Any] = field(default_factory=dict)
    inputs: str | None = None
    run: str | None = None
    seeds: range | None = None

    def counts(self, seed: int) -> bool:
        """Return whether the episode of a seed was requested."""
        return self.seeds is None or seed in self.seeds

    @property
    def protocol(self) -> dict[str, Any]:
        """Known entries of the protocol: inputs and policy."""
        return _known({INPUTS: self.inputs, POLICY: dict(self.policy) or None})

    @property
    def line(self) -> dict[str, Any]:
        """Known fields that every line of the log holds."""
        return _known({POLICY: self.policy.get("identity"), "run": self.run, INPUTS: self.inputs})


UNKNOWN_POLICY = Acting()


def _known(facts: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in facts.items() if value is not None}


# --- lines ---


class CheckpointRecord(TypedDict):
    """A memory checkpoint of a rollout. Execution steps count from 1; None if the predicate never held.

    Attributes:
        operation: Storage, Update or Compression.
        first_step: first execution step at which it held.
        ordered_step: first execution step at which it held with all earlier checkpoints complete.
    """

    operation: Literal["S", "U", "C"]
    first_step: Count | None
    ordered_step: NotRequired[Count | None]


class Outcome(TypedDict, total=False):
    """Fields of an episode that a log and a card share; logs of other tools omit some.

    Attributes:
        seed: seed of the scene: seed base + episode, except in evidence episodes.
        referent: fixed, random, or drawn (strict tasks).
        variant: index of the task's variant; 0 is the published one.
        salt: mixed into the draws of variant and holds; sealed test only.
        replan_steps: actions executed per prediction, if known.
        prompt_steps: control steps before the execution.
        steps: execution steps.
        paused_steps: control steps of pauses; only with pauses.
        held_steps: control steps of holds; strict tasks only.
        corrupt: delete, swap or noise of the policy's memory; absent without.
        corrupt_step: execution step of the corruption; absent for 0, the end of the prompt.
        reshow: whether the prompt played a second time; absent without.
        interference: number of episodes of other tasks before the execution; absent without.
        corrupted: whether the memory was corrupted before the episode ended.
        choice: evidence episodes: variant that the policy acted on; None for no variant.
        answered: evidence episodes: whether the policy gave an answer. A wrong answer may fit no variant.
        variants: evidence episodes: number of variants of the task.
        chance: evidence episodes: rate of correct choices without memory; None if the instruction names the variant.
        failure: failure class; None for a success.
        suite: ``strict``, or a suite of LIBERO; absent for published tasks.
        difficulty: absent for the standard one.
        world: ``libero``; absent for the scenes that version 0.2 modelled in code.
        stand_ins: classes whose missing scans this package's objects replaced.
        protocol: ``upstream``, the authors' evaluation; absent for the paper's.
        convention: of the pictures; absent for upright ones.
        observation_height: of the pictures, pixels; absent for 256.
        observation_width: of the pictures, pixels; absent for 256.
        camera_name_mapping: LIBERO's names of cameras -> names of pictures; absent without.
        lost: strict tasks: whether the goal became unreachable.
        fault: reason why the episode was aborted: an invalid action or unstable physics.
        scene_hash: hash of the initial scene.
        settled: false if an object was thrown, or still moved, when the scene began; absent otherwise.
    """

    seed: Whole | None
    referent: Name
    variant: Count | None
    salt: Name
    replan_steps: Count | None
    prompt_steps: Count | None
    steps: Count | None
    paused_steps: Whole
    held_steps: Whole
    corrupt: Name
    corrupt_step: Count
    reshow: bool
    interference: Count
    corrupted: bool
    choice: Count | None
    answered: bool
    variants: Count
    chance: Number | None
    failure: Name | None
    suite: Name
    difficulty: Difficulty
    world: Name
    stand_ins: list[Name]
    protocol: Name
    convention: Name
    observation_height: Count
    observation_width: Count
    camera_name_mapping: dict[Name, Name]
    lost: bool
    fault: str
    scene_hash: Name | None
    settled: bool


class EpisodeRecord(Outcome):
    """A line of the log.

    Attributes:
        task: name in the catalogue.
        memory_type: temporal, spatial, object or procedural; the suite of a task of LIBERO.
        episode: number of the episode in its evaluation, from 0.
        success: whether the goal held at the end.
        checkpoints: memory checkpoints in the task's order.
        prompt_shown: whether the demonstration prompt succeeded; None without a prompt.
        wall_s: duration of the episode, s.
        not_run: reason why the episode could not be run. Such a line is no rollout and enters no rate.
        policy: type and hash of the policy.
        run: name of the start of the evaluation.
        inputs: inputs of the policy.
        written_at: time of writing, s since 1970; in the workers' files only.
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
    """Return the log line of an episode, an `EpisodeRecord`.

    Args:
        number: number of the episode in its evaluation, from 0.
        wall_s: duration of the episode, s.
    """
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
        "referent": episode.referent,
        "variant": task.variant_index,
        **({"salt": episode.settings.salt} if episode.settings.salt else {}),
        "replan_steps": episode.settings.replan_steps,
        "prompt_steps": episode.exec_start if episode.exec_start is not None else episode.step_index,
        "prompt_shown": episode.prompt_shown,
        "steps": episode.exec_steps,
        **({"paused_steps": episode.pacing.paused_steps} if episode.pacing.pauses else {}),
        **_memory_controls(episode),
        "success": episode.success,
        **({} if choice is None else evidence_line(task, choice.variant, choice.answered)),
        "checkpoints": [
            {"operation": checkpoint.operation, "first_step": first, "ordered_step": ordered}
            for checkpoint, first, ordered in steps
        ],
        "failure": failure if fault is None else fault.failure,
        **({} if fault is None else {"fault": fault.why}),
        **({} if task.suite == PUBLISHED else {"suite": task.suite}),
        **({"lost": episode.lost, "held_steps": episode.pacing.held_steps} if task.suite == STRICT else {}),
        **({} if task.difficulty == STANDARD else {"difficulty": task.difficulty}),
        **{WORLD: LIBERO, "stand_ins": list(episode.stand_ins)},
        **({} if episode.settings.protocol == BY_PAPER else {"protocol": episode.settings.protocol}),
        "scene_hash": episode.scene_hash,
        **({} if episode.sim.settled else {"settled": False}),
        "wall_s": round(wall_s, 3),
    }


def _memory_controls(episode: Episode) -> dict[str, Any]:
    """Return the settings of corruption and interference that differ from the protocol's, and their effect."""
    settings = episode.settings
    found = {name: value for name, usual in MEMORY_CONTROLS.items() if (value := getattr(settings, name)) != usual}
    return found | ({"corrupted": episode.corrupted} if "corrupt" in found else {})


def evidence_line(task: Task, choice: int | None, answered: bool) -> dict[str, Any]:
    """Return the fields of an evidence episode's line that describe the choice among a task's variants."""
    return {"choice": choice, "answered": answered, "variants": len(task.random_variants), "chance": chance(task)}


def key_of(record: Mapping[str, Any]) -> tuple[str, int, str]:
    """Return the identity of an episode: task, number, referent."""
    return record["task"], record["episode"], record.get("referent", "fixed")


def not_run_record(
    task: Task, number: int, seed: int, referent: str, why: str, variants: int | None = None
) -> dict[str, Any]:
    """Return the log line of an episode that could not be run; arguments are fields of `EpisodeRecord`."""
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
        **({} if task.difficulty == STANDARD else {"difficulty": task.difficulty}),
        WORLD: LIBERO,
        "not_run": why,
    }


# --- writing ---


class EpisodeLog:
    """Append finished rollouts of this process to ``directory``, which is created when the first rollout ends.

    Args:
        begin: called once before the first line is written; may raise.
    """

    def __init__(self, directory: str | Path, begin: Callable[[], object] | None = None) -> None:
        self.directory = Path(directory)
        self._begin = begin

    def append(self, record: Mapping[str, Any]) -> Path:
        """Write one rollout durably and return its file.

        The process id is read here, not at construction: a log may be constructed before a fork.

        Raises:
            MemobenchError: the folder cannot be written or holds episodes of another protocol, the record is not JSON,
                or its task's name is not a file name.
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


def write_episodes(directory: str | Path, records: list[dict[str, Any]]) -> Path:
    """Add missing ``records`` to ``<directory>/episodes.jsonl`` atomically and return its path.

    Existing lines stay unchanged, including unreadable ones. Readers use the last line of an episode.
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
    """Return the rollouts logged in ``directory``, see `read_log`; ``problems`` also names episodes not run."""
    records = read_log(directory, problems)
    if problems is not None:
        problems += notes_on_not_run(records)
    return [record for record in records if "not_run" not in record]


def not_run(records: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Return task -> its episodes that could not be run."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        if "not_run" in record:
            found.setdefault(record["task"], []).append(record)
    return found


def notes_on_not_run(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one sentence per task with episodes that could not be run; it contains the first reason."""
    notes = []
    for task, lines in not_run(records).items():
        whole_task = len(lines) == sum(record["task"] == task for record in records)
        part = "was not run" if whole_task else f"was not run in {count_of(len(lines), 'episode')}"
        notes.append(f"{task} {part}, and the figures are without that: {lines[0]['not_run']}")
    return notes


def read_log(directory: str | Path, problems: list[str] | None = None) -> list[dict[str, Any]]:
    """Return all lines logged in ``directory``, sorted by task, episode and referent, including episodes not run.

    Reads the workers' files and ``episodes.jsonl``, which may be compressed by ``gzip``. The newest line of an episode
    counts. Unreadable lines, such as the last line of a killed run, are skipped. They are added to ``problems`` (file,
    line, reason), or logged as warnings without it, as are episodes with lines of both outcomes.

    Raises:
        MemobenchError: the folder does not exist, contains no log, or contains a log of several policies.
    """
    directory = Path(directory)
    if not directory.is_dir():
        hint = f", such as {directory.parent}" if directory.is_file() and _log_files(directory.parent) else ""
        raise MemobenchError(f"{directory} is not a folder; expected one that an evaluation has written{hint}")
    files = _log_files(directory)
    if not files and (directory / "meta" / "info.json").is_file():
        raise MemobenchError(
            f"{directory} is a LeRobotDataset, expected the folder of an evaluation; read it by `memobench describe`"
        )
    if not files:
        nested = (file for depth in ("*", "*/*") for file in sorted(directory.glob(f"{depth}/{MERGED_FILE}*")))
        first = next(nested, None)
        raise MemobenchError(
            f"{directory} holds no episode log; expected {MERGED_FILE} or {EPISODES_FOLDER}/*.jsonl, as an "
            f"evaluation writes them{'' if first is None else f'; there is one in {first.parent}'}"
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
    twice = sorted(key for key, values in outcomes.items() if len(values) > 1)
    if twice:
        found.append(
            f"{directory} has lines of success and of failure about {count_of(len(twice), 'episode')}, the first is "
            f"{twice[0][0]}, episode {twice[0][1]}; the newest line of each counts"
        )
    if problems is not None:
        problems += found
    else:
        for problem in found:
            logger.warning("%s", problem)
    return [newest[key][1] for key in sorted(newest)]


def _check_one_policy(directory: Path, policies: Mapping[str | None, tuple[Path, Mapping[str, Any]]]) -> None:
    """Raise for a log of several policies (identity -> file and one of its lines), whose rates would be mixed."""
    known = [(name, *place) for name, place in policies.items() if name is not None]
    if len(known) > 1:
        named = " and ".join(f"{name} ({record['task']}, in {file.name})" for name, file, record in known[:2])
        raise MemobenchError(
            f"{directory} holds episodes of {len(known)} policies: {named}; they are not one evaluation. Evaluate each "
            "into a folder of its own, or sort the lines by their `policy` into such folders"
        )


def has_log(directory: Path) -> bool:
    """Return whether ``directory`` contains rollouts of an evaluation."""
    return bool(_log_files(directory))


def is_archive(directory: Path) -> bool:
    """Return whether the log in ``directory`` is a single compressed file, which is read-only."""
    return _log_files(directory) == [packed(directory / MERGED_FILE)]


def _log_files(directory: Path) -> list[Path]:
    """Return the merged file first: its lines have no time, so lines of the workers' files replace them."""
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


OMITTED: dict[str, Any] = {
    **{"suite": PUBLISHED, WORLD: FORMER, "difficulty": STANDARD, "protocol": BY_PAPER},
    **PICTURES,
    **{"camera_name_mapping": None, "robot_state": False},
    **{"pause_steps": 0, "speed": 1.0, "evidence": False, HOLD: 0, GOALS: 1, SCENE_HASHES: 1, "render_every": 1},
    **{"window_steps": 1, "delay_steps": 0, "salt": None},
    **MEMORY_CONTROLS,
}
"""Values of settings that a protocol omits because they did not exist when it was written. ``render_every``, control
steps per rendered picture, exists in earlier versions only."""
OF_ONE_EVALUATION = ("prompt_in", "window_steps", "delay_steps", "camera_name_mapping", "robot_state", INPUTS, "salt")
"""Settings that follow from the policy, and the salt, which the start of a sealed evaluation draws. They may differ
between compared evaluations, not between parts of one."""
EXTENT = ("tasks", "episodes")
"""Extent of an evaluation. It may differ between compared evaluations, which use their common episodes."""
MOST_EPISODES = 100_000
"""Largest number of episodes of one task; bounds the memory that a damaged file can request."""
Episodes = Annotated[int, Ge(0), Le(MOST_EPISODES)]


def with_omitted(protocol: Mapping[str, Any]) -> dict[str, Any]:
    """Return a protocol with the values of settings that earlier versions omit."""
    return {**OMITTED, **protocol}


def differences(
    a: Mapping[str, Any],
    b: Mapping[str, Any],
    *,
    extent: bool = False,
    policy: bool = False,
    ignore: Collection[str] = (),
) -> list[str]:
    """Return the settings in which two protocols differ, each as ``horizon: 1200 and 600``.

    A setting that one protocol omits (logs of other tools) is no difference, unless it is in `OMITTED`.

    Args:
        extent: whether tasks and number of episodes are compared.
        policy: whether the policy's identity and the version of scene hashes are compared, as between parts of one
            evaluation.
        ignore: settings that may differ.
    """
    left_out = {*ignore, POLICY, *(() if extent else EXTENT), *(() if policy else (SCENE_HASHES,))}
    first = {k: v for k, v in with_omitted(a).items() if k not in left_out}
    found = _differing(first, with_omitted(b))
    earlier = " (an earlier version hashed scenes otherwise)"
    found = [f"{each}{earlier if each.startswith(SCENE_HASHES) else ''}" for each in found]
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
