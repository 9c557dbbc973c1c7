"""Studies of many tasks, shared out: every scene, then every search, is a piece of work for some process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_memobench.evaluation.necessity.study import Piece, Study
from lerobot_memobench.jobs.executors import run_jobs
from lerobot_memobench.jobs.processes import ProgressCallback

PIECES: dict[Piece, str] = {"scene": "scenes", "search": "searches"}
"""In the order in which they are made, and what several are called."""


@dataclass(frozen=True)
class PieceJob:
    """One piece of a study as `jobs` runs it.

    Attributes:
        study: of one task under one setting.
        piece: what is made. seed: of its scene.
    """

    study: Study
    piece: Piece
    seed: int

    @property
    def folder(self) -> Path:
        """The file of the piece."""
        return self.study.piece(self.piece, self.seed).path

    @property
    def task_name(self) -> str:
        """The task, and what is done."""
        return f"{self.piece} of {self.study.task.name}, referent {self.study.referent}"

    def run(self) -> None:
        """Make the piece and keep it."""
        self.study.piece(self.piece, self.seed).get()

    def finished(self) -> bool:
        """Whether the piece is there."""
        return self.study.piece(self.piece, self.seed).found() is not None

    def failure(self) -> None:
        """A piece that cannot be made is an error."""


def make(studies: Sequence[Study], piece: Piece, workers: int, progress: ProgressCallback | None = None) -> None:
    """Make one piece of every scene of the studies, those that are there excepted; searches only where asked for."""
    asked = [study for study in studies if piece == "scene" or study.searched]
    jobs = [PieceJob(study, piece, seed) for study in asked for seed in study.settings.seeds]
    if jobs:
        run_jobs(jobs, workers=workers, progress=progress, logs=studies[0].out / "logs")
