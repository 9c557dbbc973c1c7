"""How much each action chunk of an evaluation has read of what its policy remembers: one small file per episode.

``memory_reads=true`` writes ``memory_reads/<task>.<episode>.json.gz`` beside the log. No rate needs it; the HTML report
draws it.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

from lerobot_memobench.envs.settings import RESET
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import seed_base
from lerobot_memobench.io import Count, Name, Number, Whole, count_of, file_name, read_json, write_file
from lerobot_memobench.tasks.task import PUBLISHED

MEMORY_READS = "memory_reads"
"""Folder of these files, in that of the log."""


class Chunk(TypedDict):
    """What one action chunk has read.

    Attributes:
        step: control step at which it was planned. The policy counts from its first observation, which is the
            execution's first where the prompt plays in ``reset``.
        entries: control steps of the frames that it could read, in ascending order; -1, -2, ... where an entry is of no
            frame, such as a slot.
        weights: how much of each, as shares of attention.
    """

    step: Count
    entries: list[Whole]
    weights: list[Number]


class EpisodeReads(TypedDict):
    """The content of a file.

    Attributes:
        seed: that of episode 0 + the episode's number; in the log stands the scene's, which several episodes share
            where each scene is run with each variant.
        referent: of the episode, as in its line of the log.
        chunks: in the order in which they were planned.
    """

    seed: Whole
    referent: Name
    chunks: list[Chunk]


def reads_file(folder: Path, task: str, episode: int) -> Path:
    """Return the place of an episode's file; ``folder`` is the log's."""
    return folder / MEMORY_READS / f"{file_name(task, 'the name of a task')}.{episode}.json.gz"


def write_reads(path: Path, reads: EpisodeReads) -> None:
    """Write an episode's file, weights to four places."""
    chunks = [{**chunk, "weights": [round(weight, 4) for weight in chunk["weights"]]} for chunk in reads["chunks"]]
    text = json.dumps({**reads, "chunks": chunks}, separators=(",", ":"))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, gzip.compress(text.encode(), mtime=0))


def find_reads(
    folder: Path, records: Sequence[Mapping[str, Any]], protocol: Mapping[str, Any]
) -> tuple[dict[int, list[Chunk]], list[str]]:
    """Return position of a rollout in ``records`` -> its chunks, and a note on files that are left out.

    Steps are those of a report's timeline: the episode's, prompt included. A timeline leaves pauses out, so nothing is
    found of a rollout with pauses.
    """
    unseen = protocol.get("prompt_in") == RESET
    found: dict[int, list[Chunk]] = {}
    misfits: list[str] = []
    for k, record in enumerate(records):
        try:
            path = reads_file(folder, record["task"], record["episode"])
            reads: EpisodeReads = read_json(path, EpisodeReads, "run the episode again")
        except FileNotFoundError:
            continue
        except MemobenchError as error:
            misfits.append(str(error))
            continue
        # The clock of a strict task counts its prompt, seen or not.
        shift = int(record.get("prompt_steps") or 0) if unseen and record.get("suite", PUBLISHED) == PUBLISHED else 0
        chunks = [_later(chunk, shift) for chunk in reads["chunks"]]
        if _is_of(reads, record) and _fit(chunks, record):
            if not record.get("paused_steps"):
                found[k] = chunks
        else:
            misfits.append(f"{path} is not of the rollout in the log")
    if not misfits:
        return found, []
    return found, [f"{count_of(len(misfits), 'file')} of {MEMORY_READS} left out, the first because {misfits[0]}"]


def _later(chunk: Chunk, shift: int) -> Chunk:
    entries = [entry + shift if entry >= 0 else entry for entry in chunk["entries"]]
    return {"step": chunk["step"] + shift, "entries": entries, "weights": chunk["weights"]}


def _is_of(reads: EpisodeReads, record: Mapping[str, Any]) -> bool:
    if record.get("seed") is None or reads["referent"] != record.get("referent", "fixed"):
        return False
    return reads["seed"] == seed_base(record) + int(record["episode"])


def _fit(chunks: Sequence[Chunk], record: Mapping[str, Any]) -> bool:
    """Return whether chunks were planned within a rollout, each with a weight per entry, which is of its past."""
    paused, steps = int(record.get("paused_steps") or 0), record.get("steps")
    end = None if steps is None else int(record.get("prompt_steps") or 0) + int(steps) + paused
    return all(
        len(chunk["entries"]) == len(chunk["weights"])
        and max(chunk["entries"], default=0) <= chunk["step"]
        and (end is None or chunk["step"] < end)
        for chunk in chunks
    )
