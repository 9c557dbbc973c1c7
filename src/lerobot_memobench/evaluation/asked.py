"""The lines of a log against the evaluation's file: episodes that it asks for, and settings that it names."""

from __future__ import annotations

import itertools
import math
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lerobot_memobench.envs.episode_log import INPUTS, OMITTED, POLICY, EpisodeRecord, differences, with_omitted
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
    """The episodes that an evaluation's file asks for.

    Attributes:
        tasks: names, sorted.
        episodes: numbers of the episodes of each task.
        shard: part of the evaluation that the file belongs to, such as ``1/8``; None for all of it.
    """

    tasks: Sequence[str]
    episodes: range
    shard: str | None

    def asks(self, record: Record) -> bool:
        """Return whether the episode of a line was asked for."""
        return record["task"] in self.tasks and record["episode"] in self.episodes

    def missing(self, lines: Iterable[Record]) -> str | None:
        """Return a sentence on the episodes without a line, None without such episodes."""
        there = {(line["task"], line["episode"]) for line in lines if self.asks(line)}
        total = len(self.tasks) * len(self.episodes)
        if len(there) == total:
            return None
        task, episode = next(each for each in itertools.product(self.tasks, self.episodes) if each not in there)
        unrun = len(self.tasks) - len({name for name, _ in there})
        return (
            f"missing: {total - len(there):,} of {count_of(total, 'episode')}"
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
    """Check that each line of a log states the settings in the evaluation's file.

    Raises:
        MemobenchError: one does not; it is named.
    """
    for line in lines if card else ():
        if found := [*_contradictions(card, line)]:
            raise MemobenchError(
                f"{folder}: {line['task']}, episode {line['episode']}, contradicts {EVALUATION_FILE} "
                f"({'; '.join(found)}, in the file and in the log); restore both files, or evaluate again"
            )


def _contradictions(card: Mapping[str, Any], line: Record) -> Iterator[str]:
    """Yield the settings that a line and the file state differently, as ``difficulty: hard and standard``."""
    held = card.get("protocol", {})
    protocol = with_omitted(held)
    protocol[POLICY] = {**(protocol.get(POLICY) or {}), **(card.get(POLICY) or {})}
    stated = _stated(line, protocol)
    # Lines of earlier versions omit settings that have another than the usual value.
    omitted = set() if SCENE_HASHES not in held else NOT_RUN if "not_run" in line else STATED
    ignored = {*OMITTED} - {*held} | {*OMITTED} - {*stated} - omitted
    ignored |= {name for name, value in held.items() if isinstance(value, list) and stated.get(name) in value}
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
    """Return the settings that a line states, as a protocol."""
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
