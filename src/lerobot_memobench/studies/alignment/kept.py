"""Of which types is what an alignment study keeps of its runs?"""

from __future__ import annotations

from typing import NotRequired, TypedDict

from lerobot_memobench.files.reading import Count, Number


class Scores(TypedDict):
    """Top-1 among all subgoals, and among those of the frame's task."""

    all: Number
    own_task: Number


class KeptRun(TypedDict):
    """A policy that was trained and measured."""

    align: str
    seed: Count
    memory: Scores
    last_frame: Scores
    head: NotRequired[Scores]
    action_loss: Number


class KeptBaselines(TypedDict):
    """What needs no training."""

    chance: Scores
    commonest: Scores
    tower_history: Scores
    tower_last_frame: Scores
    untrained_memory: Scores
    untrained_last_frame: Scores
