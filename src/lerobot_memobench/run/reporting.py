"""The report of an evaluation that has been run or merged, as the engine hands it back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_memobench.evaluation.documents.report import REPORT_MARKDOWN, write_report
from lerobot_memobench.evaluation.metrics.summary import Summary


@dataclass(frozen=True)
class EvaluationReport:
    """What an evaluation found.

    Attributes:
        folder: holds the log, and the report's files.
        summary: its figures.
        notes: what a reader must know, such as lines of the log that could not be read.
        absent: (task, episode) of those that were asked for and are missing.
    """

    folder: Path
    summary: Summary
    notes: Sequence[str]
    absent: Sequence[tuple[str, int]] = ()

    @property
    def page(self) -> Path:
        """The report as a file to read."""
        return self.folder / REPORT_MARKDOWN


def report_on(folder: Path, episodes: int | None = None, absent: Sequence[tuple[str, int]] = ()) -> EvaluationReport:
    """Write the report of the log in ``folder`` beside it and return it.

    Args:
        episodes: report those below this number; None for all.
    """
    summary, notes = write_report(folder, episodes)
    return EvaluationReport(folder, summary, notes, absent)
