"""The statistics of a dataset as its card shows them, beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.datasets.paper_figures import FAMILIES, LENGTH_BUCKETS, FamilyFigures
from lerobot_memobench.datasets.staging.episode import StagedEpisode


def storage_of(folder: Path, episodes: Sequence[StagedEpisode]) -> dict[str, float]:
    """Return bytes per memory type, and their ``total``; what belongs to no episode is shared out by frames.

    The manifest is not counted: it says what was asked for, and the same episodes are of the same size.
    """
    kept = [folder / part for part in ("data", "meta", "states", "videos")]
    total = sum(path.stat().st_size for part in kept for path in part.rglob("*") if path.is_file())
    videos = sum(episode.video_bytes for episode in episodes)
    frames = sum(episode.info["frames"] for episode in episodes)
    found: dict[str, float] = {"total": float(total)}
    for episode in episodes:
        share = episode.video_bytes + (total - videos) * episode.info["frames"] / frames
        found[episode.info["memory_type"]] = found.get(episode.info["memory_type"], 0.0) + share
    return found


def storage_by_frames(folder: Path, infos: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the same of a dataset of which only its files are known: all of it is shared out by frames."""
    kept = [path for part in ("data", "meta", "videos") for path in (folder / part).rglob("*") if path.is_file()]
    total = sum(path.stat().st_size for path in kept)
    frames = sum(info["frames"] for info in infos)
    found = {"total": float(total)}
    for info in infos:
        found[info["memory_type"]] = found.get(info["memory_type"], 0.0) + total * info["frames"] / frames
    return found


def ordered_types(infos: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the memory types of episodes, each once: the paper's in its order, then a user's own."""
    there = {info["memory_type"] for info in infos}
    return [name for name in FAMILIES if name in there] + sorted(there - set(FAMILIES))


def lengths_table(infos: Sequence[dict[str, Any]], storage: dict[str, float]) -> str:
    """Return episodes, steps and storage per memory type, and the bytes per frame."""
    rows = []
    for name in [*ordered_types(infos), "total"]:
        chosen = [info for info in infos if name in (info["memory_type"], "total")]
        rows.append([name, "here", *_lengths(chosen), _bytes(storage.get(name, 0.0))])
        if name in FAMILIES:
            rows.append(["", "paper", *_published_lengths(FAMILIES[name])])
    header = ["memory type", "", "tasks", "episodes", "steps", "mean", "median", "P95", "max", "storage"]
    frames = sum(info["frames"] for info in infos)
    return markdown(header, rows) + f"\n\n{storage['total'] / frames:,.0f} bytes per frame."


def _lengths(infos: Sequence[dict[str, Any]]) -> list[str]:
    lengths = np.array([info["frames"] for info in infos])
    tasks = len({info["task_name"] for info in infos})
    figures = [lengths.mean(), np.median(lengths), np.percentile(lengths, 95)]
    return [
        f"{tasks}",
        f"{len(infos):,}",
        f"{lengths.sum():,}",
        *(f"{x:,.2f}" for x in figures),
        f"{lengths.max():,}",
    ]


def _published_lengths(paper: FamilyFigures) -> list[str]:
    figures = [paper.mean, paper.median, paper.p95]
    return [
        f"{paper.tasks}",
        f"{paper.episodes:,}",
        f"{paper.steps:,}",
        *(f"{x:,.2f}" for x in figures),
        f"{paper.max:,}",
        f"{paper.storage:.2f} GiB",
    ]


def _bytes(size: float) -> str:
    return f"{size / 1024**3:.2f} GiB" if size >= 0.1 * 1024**3 else f"{size / 1024**2:.2f} MiB"


def buckets_table(infos: Sequence[dict[str, Any]]) -> str:
    """Return how many episodes have which length, beside the paper's."""
    lengths = np.array([info["frames"] for info in infos])
    published = sum(LENGTH_BUCKETS.values())
    rows = []
    for (low, high), theirs in LENGTH_BUCKETS.items():
        ours = int(((lengths >= low) & (lengths < (high or np.inf))).sum())
        span = f"{low:,}+" if high is None else f"{low:,}–{high - 1:,}"
        shares = [f"{100 * ours / len(lengths):.2f} %", f"{100 * theirs / published:.2f} %"]
        rows.append([span, f"{ours:,}", shares[0], f"{theirs:,}", shares[1]])
    return markdown(["length", "episodes here", "share", "episodes in the paper", "share"], rows)


def tasks_table(infos: Sequence[dict[str, Any]], failed: Sequence[StagedEpisode]) -> str:
    """Return what was solved of each task, and the seeds that were not."""
    rows = []
    for name in sorted({info["task_name"] for info in infos} | {e.info["task_name"] for e in failed}):
        chosen = [info for info in infos if info["task_name"] == name]
        seeds = [str(e.info["seed"]) for e in failed if e.info["task_name"] == name]
        mean = f"{np.mean([info['frames'] for info in chosen]):.1f}" if chosen else ""
        operations = chosen[0]["operations"] if chosen else ""
        rows.append([name, operations, f"{len(chosen)}/{len(chosen) + len(seeds)}", mean, ", ".join(seeds)])
    return markdown(["task", "operations", "solved", "mean frames", "failing seeds"], rows)


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
