"""The decisions of a strict task that its past alone answers, out of a dataset of demonstrations.

Counting and order: whenever the hand stands at home, go on or stop, or which event is next; finding, referents and
procedures: at the first frame of the execution, what the prompt showed.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.lerobot_format.layout import objects_column
from lerobot_memobench.datasets.lerobot_format.reading import RecordedEpisode, list_episodes, read_episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import OBS_STEP
from lerobot_memobench.tasks.catalogue import get_task, suite_of
from lerobot_memobench.tasks.task import STRICT, Task

COUNTING = "counting"
CONTINUE, STOP = "go on", "stop"


@dataclass(frozen=True)
class Decision:
    """A frame at which the past decides.

    Attributes:
        episode: its number in the dataset.
        step: since the execution began.
        present: (D,) what is observed: object slots, the arm's state, which of the task's instructions was given.
        answer: what is right.
    """

    episode: int
    step: int
    present: NDArray[np.float32]
    answer: str


def read_decisions(folder: Path) -> dict[str, list[Decision]]:
    """Return the decisions of each strict task in a dataset, by its name.

    Raises:
        MemobenchError: no dataset, or no strict task in it.
    """
    found: dict[str, list[Decision]] = defaultdict(list)
    for place in list_episodes(folder):
        if place.record is not None and suite_of(place.record.task_name) == STRICT:
            found[place.record.task_name] += decisions(read_episode(folder, place.index), place.index)
    if not found:
        raise MemobenchError(f"{folder} holds no demonstrations of strict tasks; generate some: --suite strict")
    return dict(sorted(found.items()))


def decisions(episode: RecordedEpisode, number: int) -> list[Decision]:
    """Return the decisions of one demonstration that reached its goal."""
    task = get_task(episode.task_name)
    variant = task.variant(episode.variant)
    columns, start = episode.columns, episode.exec_start
    arm = columns["observation.state"]
    instruction = _instructions(task).index(variant.language)
    seen = np.column_stack([columns[objects_column(columns)], arm, np.full(len(arm), instruction)]).astype(np.float32)
    if task.prompt is not None:
        frames, answers = [start], [_shown(variant)]
    else:
        frames = _home(arm, start, max(episode.whole["key_frames"]))
        answers = [str(done) for done in range(len(frames))]
        if task.family == COUNTING:
            answers = [CONTINUE] * (len(frames) - 1) + [STOP]
    offset = int(columns[OBS_STEP][start])
    steps = columns[OBS_STEP][frames].astype(int).ravel() - offset
    return [
        Decision(number, int(step), seen[frame], answer)
        for frame, step, answer in zip(frames, steps, answers, strict=True)
    ]


def _home(arm: NDArray[np.float32], start: int, end: int) -> list[int]:
    """Return the execution's first frame and those before the goal at which the hand comes home, where it stands still.

    Home has a detent, in which the arm stands as at first to the bit.
    """
    at_home = (arm == arm[start]).all(axis=1)
    arrived = np.flatnonzero(at_home[start + 1 : end] & ~at_home[start : end - 1]) + start + 1
    return [start, *arrived.tolist()]


def _shown(variant: Task) -> str:
    """Return what a variant's prompt tells: what its checkpoints ask for."""
    return json.dumps([str(checkpoint.goal) for checkpoint in variant.checkpoints])


@cache
def _instructions(task: Task) -> list[str]:
    return list(dict.fromkeys(task.variant(k).language for k in task.random_variants))


def chance(task: Task, found: Sequence[Decision]) -> float:
    """Return the share of decisions that the best constant answer to each instruction gets right.

    It is that of the draw, in which every variant comes as often, and not that of the demonstrations that happened to
    be drawn.
    """
    answers: dict[str, Counter[str]] = defaultdict(Counter)
    for k in task.random_variants:
        variant = task.variant(k)
        if task.prompt is not None:
            answers[variant.language][_shown(variant)] += 1
        elif task.family == COUNTING:
            answers[variant.language] += Counter({CONTINUE: k + 1, STOP: 1})
        else:
            answers[variant.language] += Counter({one.answer for one in found})
    total = sum(counter.total() for counter in answers.values())
    return sum(max(counter.values()) for counter in answers.values()) / total
