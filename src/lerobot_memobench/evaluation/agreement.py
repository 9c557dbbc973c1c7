"""Agreement of a log with the evaluation's file, and of two records of an episode.

The file names the requested episodes and the settings of all lines; a result card also holds their outcomes.
"""

from __future__ import annotations

import itertools
import math
import typing
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lerobot_memobench.envs.episode_log import INPUTS, OMITTED, POLICY, EpisodeRecord, differences, key_of, with_omitted
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE
from lerobot_memobench.envs.settings import SCENE_HASHES, SETTINGS, steps_per_action
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import Record, seed_base
from lerobot_memobench.io import count_of
from lerobot_memobench.sim.scene_hash import WORLD
from lerobot_memobench.tasks.catalogue import group_of, suite_of
from lerobot_memobench.tasks.task import REFERENTS, STRICT

# --- extent ---


class Extent(NamedTuple):
    """The episodes that an evaluation's file requests.

    Attributes:
        tasks: names, sorted.
        episodes: numbers of the episodes of each task.
        shard: part of the evaluation that the file belongs to, such as ``1/8``; None for all of it.
    """

    tasks: Sequence[str]
    episodes: range
    shard: str | None

    def includes(self, record: Record) -> bool:
        """Return whether the episode of a line was requested."""
        return record["task"] in self.tasks and record["episode"] in self.episodes

    def missing(self, lines: Iterable[Record]) -> str | None:
        """Return a sentence on the episodes without a line, None without such episodes."""
        logged = {(line["task"], line["episode"]) for line in lines if self.includes(line)}
        total = len(self.tasks) * len(self.episodes)
        if len(logged) == total:
            return None
        task, episode = next(each for each in itertools.product(self.tasks, self.episodes) if each not in logged)
        unrun = len(self.tasks) - len({name for name, _ in logged})
        return (
            f"missing: {total - len(logged):,} of {count_of(total, 'episode')}"
            f"{f', with all of {count_of(unrun, "task")}' if unrun else ''}, the first is {task}, episode {episode}"
            f"{f', in part {self.shard} of an evaluation' if self.shard else ''}; run the same command, or the missing "
            "parts, with resume=true"
        )


def extent_of(card: Mapping[str, Any], lines: Iterable[Record]) -> Extent | None:
    """Return the episodes that an evaluation's file asks for, None where it does not name their number.

    Where it does not name the tasks, they are those of the log's lines.
    """
    protocol = card.get("protocol", {})
    tasks, count, base = (protocol.get(key) for key in ("tasks", "episodes", "seed_base"))
    if count is None:
        return None
    tasks = tasks or (line["task"] for line in lines)
    seed = (card.get(POLICY) or {}).get("seed")
    first = seed - base if isinstance(seed, int) and isinstance(base, int) else 0
    return Extent(sorted({*tasks}), range(first, first + count), card.get("shard"))


# --- settings ---

STATED = {*SETTINGS, INPUTS} & {*typing.get_type_hints(EpisodeRecord)}
"""Settings that the file and each line hold under one name."""
NOT_RUN = {"suite", WORLD, "difficulty"}
"""Settings that a line omits for their usual value even where its episode was not run."""
REQUIRED: Mapping[str, tuple[str, Any]] = {
    **dict.fromkeys(("choice", "answered", "variants", "chance"), ("evidence", True)),
    **dict.fromkeys(("lost", "held_steps"), ("suite", STRICT)),
}
"""Field that a line holds under one setting only -> that setting and its value."""


def check_lines(folder: Path, card: Mapping[str, Any], lines: Iterable[Record]) -> None:
    """Raise `MemobenchError` for the first line of a log that contradicts the settings in the evaluation's file."""
    for line in lines if card else ():
        if contradictions := [*_contradictions(card, line)]:
            raise MemobenchError(
                f"{folder}: {line['task']}, episode {line['episode']}, contradicts {EVALUATION_FILE} "
                f"({'; '.join(contradictions)}, in the file and in the log); restore both files, or evaluate again"
            )


def _contradictions(card: Mapping[str, Any], line: Record) -> Iterator[str]:
    """Yield the settings that a line and the file state differently, as ``difficulty: hard and standard``."""
    stored = card.get("protocol", {})
    protocol = with_omitted(stored)
    protocol[POLICY] = {**(protocol.get(POLICY) or {}), **(card.get(POLICY) or {})}
    stated = _stated(line, protocol)
    # Lines of earlier versions omit settings that have another than the usual value.
    omitted = set() if SCENE_HASHES not in stored else NOT_RUN if "not_run" in line else STATED
    ignored = {*OMITTED} - {*stored} | {*OMITTED} - {*stated} - omitted
    ignored |= {name for name, value in stored.items() if isinstance(value, list) and stated.get(name) in value}
    yield from differences(protocol, stated, policy=True, ignore=ignored)
    horizon, speed = protocol.get("horizon"), protocol["speed"]
    most = horizon * steps_per_action(speed) if isinstance(horizon, int) and speed else math.inf
    if (line.get("steps") or 0) > most:
        yield f"steps: at most {most} and {line['steps']}"
    if line.get("referent") == REFERENTS[0] and line.get("variant") and not protocol["evidence"]:
        yield f"variant: 0 and {line['variant']}"
    if suite_of(line["task"]) is not None and not (card.get("settings") or {}).get("env", {}).get("task_dir"):
        memory_type = group_of(line["task"])
        yield from differences({"memory_type": memory_type}, {"memory_type": line["memory_type"]})


def _stated(line: Record, protocol: Mapping[str, Any]) -> dict[str, Any]:
    stated = {name: line[name] for name in STATED if name in line}
    stated |= {name: value for field, (name, value) in REQUIRED.items() if field in line}
    if line.get("seed") is not None:
        stated["seed_base"] = seed_base(line)
    if line.get(POLICY):
        stated[POLICY] = {"type": line[POLICY].split(" ")[0], "identity": line[POLICY]}
    if "corrupted" in line:
        stated.setdefault("corrupt", "some kind")
    if "not_run" not in line:
        paused = line.get("paused_steps")
        stated.setdefault("evidence", False)
        stated["pause_steps"] = 0 if paused is None else protocol["pause_steps"] or f"{paused} in all"
    return stated


# --- outcomes ---

SCENES = "scene_hash"
OUTCOME = (
    *("success", "steps", "prompt_steps", "variant", "choice", "checkpoints", "failure", "fault", "not_run"),
    *("stand_ins", SCENES),
)
"""Fields in which two runs of the same episode must agree."""


def outcome(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a log line that a card keeps: its identity and its outcome, without times."""
    identity = ("task", "memory_type", "episode", "seed", "referent", "difficulty", "salt")
    return {key: record[key] for key in (*identity, *OUTCOME) if key in record}


def disagreement(
    a: Mapping[str, Any],
    b: Mapping[str, Any],
    here: str = "here",
    there: str = "there",
    ignore: Collection[str] = (),
) -> str | None:
    """Return a phrase for the first difference of two records of the same episode, None where they agree.

    Times, fields to ``ignore``, and fields that one of them lacks, do not count.
    """
    if ("not_run" in a) != ("not_run" in b):
        return f"{_name(a)} was not run {here if 'not_run' in a else there}"
    for name in ("seed", "replan_steps", *OUTCOME):
        if name in ignore or name not in a or name not in b or a[name] == b[name]:
            continue
        values = [(name, a[name], b[name])]
        if name == "checkpoints" and len(a[name]) == len(b[name]):
            values = [
                (f"{key} of checkpoint {number}", mine.get(key), other.get(key))
                for number, (mine, other) in enumerate(zip(a[name], b[name], strict=True), start=1)
                for key in ("operation", "first_step", "ordered_step")
            ]
        for field, mine, other in values:
            if mine != other:
                return f"{_name(a)}: {field} is {mine} {here} and {other} {there}"
    return None


def disagreements(
    card: Sequence[Mapping[str, Any]],
    records: Sequence[Mapping[str, Any]],
    there: str = "in the log",
    ignore: Collection[str] = (),
) -> list[str]:
    """Return a phrase for each episode that differs between a card and a log, or that one of them lacks."""
    logged, carded = ({key_of(each): each for each in some} for some in (records, card))
    phrases: list[str | None] = []
    for key in sorted({*logged, *carded}):
        if key not in logged:
            phrases.append(f"{_name(carded[key])} is on the card and not {there}")
        elif key not in carded:
            phrases.append(f"{_name(logged[key])} is {there} and not on the card")
        else:
            phrases.append(disagreement(carded[key], logged[key], "on the card", there, ignore))
    return [phrase for phrase in phrases if phrase is not None]


def _name(record: Mapping[str, Any]) -> str:
    return f"{record['task']}, episode {record['episode']}"
