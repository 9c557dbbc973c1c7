"""A piece of work, and what is told when one is finished."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


class Job(Protocol):
    """A piece of work. Pickled to other processes and machines, so ``folder`` is on a disk they share."""

    @property
    def folder(self) -> Path:
        """Where the result goes; no two jobs have the same."""

    @property
    def task_name(self) -> str:
        """What the job is called when its end is told."""

    @property
    def seed(self) -> int:
        """Its number among those of that name."""

    def run(self) -> None:
        """Leave the result, or the reason why there is none, in ``folder``."""

    def finished(self) -> bool:
        """Whether ``folder`` holds everything that the job had to leave there."""

    def failure(self) -> str | None:
        """Why a finished job has no result, or None."""


@dataclass(frozen=True)
class Advance:
    """Told to the progress callback after each job: how many are finished, and the newest one's identity.

    ``found`` of those finished were so before this run began.
    """

    done: int
    total: int
    task_name: str
    seed: int
    failure: str | None
    found: int = 0


ProgressCallback = Callable[[Advance], None]
