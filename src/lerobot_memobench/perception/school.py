"""From nothing to eyes, and from eyes to figures: pictures are made where they are missing, then learned from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import Advance
from lerobot_memobench.perception.kinds import kinds
from lerobot_memobench.perception.pictures import Pictures, make_pictures
from lerobot_memobench.perception.report import COLUMNS, Examined, drawn, write_report
from lerobot_memobench.perception.testing import milliseconds, object_outcomes, outcomes, seeing
from lerobot_memobench.perception.training import Progress, Training, train
from lerobot_memobench.perception.weights import load_eyes
from lerobot_memobench.sim.simulation import MJCF_CAMERAS

TRAINED, TESTED = range(20_000, 40_000), range(40_000, 60_000)
"""Seeds that eyes may be trained and tested on. The evaluation's (7 to 56) are in neither."""
DRAWN_ROWS = 4
"""Rows of pictures that a test draws."""


@dataclass(frozen=True)
class Lessons:
    """Which pictures are made.

    Attributes:
        names: of tasks. first_seed: of the episodes. episodes: of each task. moments: of each episode, six pictures
            each. workers: processes that make pictures.
    """

    names: Sequence[str]
    first_seed: int
    episodes: int
    moments: int
    workers: int = 1

    def pictures(self, folder: Path, allowed: range, progress: Callable[[Advance], None] | None) -> Pictures:
        """Make those that are missing, and return all.

        Raises:
            MemobenchError: a seed is not one of those allowed.
        """
        seeds = range(self.first_seed, self.first_seed + self.episodes)
        if seeds[0] not in allowed or seeds[-1] not in allowed:
            raise MemobenchError(
                f"the seeds {seeds[0]} to {seeds[-1]} were asked for; here they are {allowed[0]} to {allowed[-1]}, so "
                "that nothing is tested on what it was trained on"
            )
        return make_pictures(folder, self.names, seeds, self.moments, workers=self.workers, progress=progress)


def learn(
    folder: Path,
    lessons: Lessons,
    settings: Training,
    *,
    made: Callable[[Advance], None] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Make pictures into a folder and train eyes on them there; return the file of the weights.

    The same call goes on with what an earlier one left. ``made`` is told of episodes, ``progress`` of updates.
    """
    return train(lessons.pictures(folder / "pictures", TRAINED, made), kinds(), folder, settings, progress=progress)


def examine(file: Path, folder: Path, lessons: Lessons, *, made: Callable[[Advance], None] | None = None) -> str:
    """Make other pictures into a folder and write what the eyes of a file see in them; return the table.

    Raises:
        MemobenchError: the file holds no eyes, or such that know other kinds of things.
    """
    eyes = load_eyes(file)
    if eyes.kinds != kinds():
        raise MemobenchError(f"the eyes of {file} know other kinds of things than there are now; train them anew")
    pictures = lessons.pictures(folder / "pictures", TESTED, made)
    told, false = outcomes(seeing(eyes), pictures)
    tokens, pooled = (outcomes(seeing(eyes, reading), pictures)[0] for reading in ("tokens", "pooled"))
    took = milliseconds(eyes.tower)
    tested = Examined(eyes.kinds, told, tokens, pooled, false, len(pictures), took, *object_outcomes(eyes, pictures))
    count = min(len(pictures), COLUMNS * DRAWN_ROWS)
    chosen = np.linspace(0, len(pictures) - 1, count).astype(np.int64)
    rows = pictures.rows(chosen - (chosen + np.arange(count)) % len(MJCF_CAMERAS))  # one camera's after the other's
    return write_report(tested, drawn(rows, seeing(eyes)(rows), eyes.kinds), folder)
