"""What a run of generation made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_memobench.tasks.task import Task


@dataclass(frozen=True)
class Failure:
    """A seed without a demonstration, and why."""

    task_name: str
    seed: int
    reason: str


@dataclass(frozen=True)
class TaskSummary:
    """What became of one task: ``frames`` are those of its successful episodes, holding frames included."""

    name: str
    memory_type: str
    episodes: int
    solved: int
    frames: tuple[int, ...]
    failures: tuple[Failure, ...]


@dataclass(frozen=True)
class GenerationSummary:
    """What a run made.

    Attributes:
        folder: what was made, or None when no episode succeeded, or none is there yet.
        tasks: one entry per task, in the order asked for.
        submitted: the episodes are being made on Slurm, whose last job will write the dataset.
    """

    folder: Path | None
    tasks: tuple[TaskSummary, ...]
    submitted: bool = False

    @property
    def failures(self) -> tuple[Failure, ...]:
        """All seeds without a demonstration."""
        return tuple(failure for task in self.tasks for failure in task.failures)

    @property
    def exit_status(self) -> int:
        """0 when every seed asked for was solved, else 1."""
        return 1 if self.failures else 0


def summarise(rows: Sequence[dict[str, Any]], tasks: Sequence[Task], out: Path) -> GenerationSummary:
    """Return what became of each task, from what is known of each episode."""
    summaries = tuple(_summary(task, [row for row in rows if row["task_name"] == task.name]) for task in tasks)
    made = any(summary.solved for summary in summaries)
    return GenerationSummary(out if made else None, summaries)


def _summary(task: Task, rows: Sequence[dict[str, Any]]) -> TaskSummary:
    frames = tuple(int(row["frames"]) for row in rows if row["failure"] is None)
    failures = tuple(Failure(task.name, row["seed"], row["failure"]) for row in rows if row["failure"] is not None)
    return TaskSummary(task.name, task.memory_type, len(rows), len(frames), frames, failures)
