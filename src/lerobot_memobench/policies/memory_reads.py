"""Memory reads: the share of each remembered frame, keyframe or slot in the attention of an action chunk.

``memory_reads=true`` writes ``memory_reads/<task>.<episode>.json.gz`` next to the log as each episode ends. Rates do
not need these files; the HTML report draws them.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.settings import RESET
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.io import file_name, write_file
from lerobot_memobench.tasks.task import PUBLISHED
from lerobot_memobench.untrusted import Count, Name, Number, Whole, read_json

if TYPE_CHECKING:
    from torch import Tensor

    from lerobot_memobench.envs.settings import EnvSettings
    from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens

MEMORY_READS = "memory_reads"
"""Folder of the files, within that of the log."""


class Chunk(TypedDict):
    """The reads of one action chunk. Steps are control steps, counted from the policy's first observation."""

    step: Count  # of the plan
    entries: list[Whole]  # steps of the readable frames, ascending; -1, -2, ... for entries without a frame
    weights: list[Number]  # share of attention on each entry; the sum is one if only memory is attended to


class EpisodeReads(TypedDict):
    """The content of a file, with chunks in the order of their plans."""

    seed: Whole
    """The seed of episode 0 plus the episode's number. The log has the scene's seed, shared by its variants."""
    referent: Name
    chunks: list[Chunk]


# --- from attention to chunks ---


def chunk_reads(steps: list[int], memory: MemoryTokens, layers: list[Tensor]) -> list[Chunk]:
    """Return the reads of the chunks of B rows that are planned at these control steps.

    Attention on each token, (B, L) for each layer and pass, is averaged over them, and summed over the tokens of an
    entry, or over its shares of tokens (`MemoryTokens.sources`).
    """
    import torch
    from einops import einsum

    weights, real = torch.stack(layers).float().mean(dim=0), memory.mask
    if memory.sources is not None:
        shares, entries = memory.sources
        weights, real = einsum(weights, shares, "b l, b l e -> b e"), entries >= 0
    else:
        entries = (-1 - torch.arange(real.shape[1], device=real.device)).expand_as(real)
        if memory.steps is not None:
            entries = torch.where(memory.steps < 0, entries, memory.steps)
    chunks: list[Chunk] = []
    for step, entry, weight, is_real in zip(steps, entries, weights, real, strict=True):
        unique, index = entry[is_real].float().round().long().unique(return_inverse=True)
        shares = torch.zeros(len(unique), device=weight.device).index_add(0, index, weight[is_real].float())
        chunks.append({"step": step, "entries": unique.tolist(), "weights": shares.tolist()})
    return chunks


# --- files ---


def reads_file(folder: Path, task: str, episode: int) -> Path:
    """Return the path of an episode's file in the folder of its log."""
    return folder / MEMORY_READS / f"{file_name(task, 'the name of a task')}.{episode}.json.gz"


def write_reads(path: Path, reads: EpisodeReads) -> None:
    """Write an episode's file, weights to four places."""
    chunks = [{**chunk, "weights": [round(weight, 4) for weight in chunk["weights"]]} for chunk in reads["chunks"]]
    text = json.dumps({**reads, "chunks": chunks}, separators=(",", ":"))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, gzip.compress(text.encode(), mtime=0))


@contextmanager
def noting_reads(
    folder: Path, settings: EnvSettings, task: str, policy: Any, seeds: Sequence[int]
) -> Iterator[Callable[[NDArray[np.bool_]], None]]:
    """Watch a batch of rollouts; the yielded function writes the reads of finished episodes, a mask (rows,).

    ``folder`` is that of the log. Episodes already in it are not planned and keep their files.
    """
    policy.watch_memory()
    written = np.zeros(len(seeds), bool)

    def ended(over: NDArray[np.bool_]) -> None:
        if (over == written).all():
            return
        rows = policy.memory_reads()
        for row in np.flatnonzero(over & ~written):
            written[row] = True
            if row < len(rows) and rows[row]:
                reads: EpisodeReads = {"seed": seeds[row], "referent": settings.referent, "chunks": rows[row]}
                write_reads(reads_file(folder, task, seeds[row] - settings.seed_base), reads)

    try:
        yield ended
        ended(np.ones(len(seeds), bool))
    finally:
        policy.watch_memory(False)


def find_reads(
    folder: Path, records: Sequence[Mapping[str, Any]], protocol: Mapping[str, Any]
) -> tuple[dict[int, list[Chunk]], list[str]]:
    """Return index of a rollout in ``records`` -> its chunks, and a note about ignored files.

    Steps count from the episode's beginning, prompt included, as in a report's timeline. Timelines have no pauses, so
    rollouts with pauses have no chunks.
    """
    unseen = protocol.get("prompt_in") == RESET
    chunks_of: dict[int, list[Chunk]] = {}
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
        # The clock of a strict task counts its prompt, even if the policy did not see it.
        shift = int(record.get("prompt_steps") or 0) if unseen and record.get("suite", PUBLISHED) == PUBLISHED else 0
        chunks = reads["chunks"]
        for chunk in chunks:
            chunk["step"] += shift
            chunk["entries"] = [entry + shift if entry >= 0 else entry for entry in chunk["entries"]]
        if not _fit(reads, chunks, record):
            misfits.append(f"{path} is not of the rollout in the log")
        elif not record.get("paused_steps"):
            chunks_of[k] = chunks
    if not misfits:
        return chunks_of, []
    return chunks_of, [f"{count_of(len(misfits), 'file')} of {MEMORY_READS} left out, the first because {misfits[0]}"]


def _fit(reads: EpisodeReads, chunks: Sequence[Chunk], record: Mapping[str, Any]) -> bool:
    """Return whether reads are of a rollout, and all chunks lie within it, with one weight per entry and none ahead."""
    if record.get("seed") is None or reads["referent"] != record.get("referent", "fixed"):
        return False
    scene = int(record["episode"]) // int(record.get("variants") or 1)
    if reads["seed"] - int(record["episode"]) != int(record["seed"]) - scene:
        return False
    paused, steps = int(record.get("paused_steps") or 0), record.get("steps")
    end = None if steps is None else int(record.get("prompt_steps") or 0) + int(steps) + paused
    return all(
        len(chunk["entries"]) == len(chunk["weights"])
        and max(chunk["entries"], default=0) <= chunk["step"]
        and (end is None or chunk["step"] < end)
        for chunk in chunks
    )
