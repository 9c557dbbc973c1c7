"""Of which types is what an alignment study keeps of its runs?"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from lerobot_memobench.io import Count, Number, read_json, write_file


class Scores(TypedDict):
    """Top-1 among all subgoals, and among those of the frame's task."""

    all: Number
    own_task: Number


class KeptRun(TypedDict):
    """What was measured on a trained policy: its actions, and its memory if it has one; seconds that this took."""

    arm: str
    seed: Count
    memory: NotRequired[Scores]
    last_frame: NotRequired[Scores]
    head: NotRequired[Scores]
    action_loss: float
    wall_s: Number
    cpu_s: Number


class KeptBaselines(TypedDict):
    """What needs no training."""

    chance: Scores
    commonest: Scores
    untrained_memory: Scores
    untrained_last_frame: Scores


def kept_or_made(path: Path, schema: Any, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what ``path`` holds; where there is no such file, what ``make`` returns, written there.

    Raises:
        MemobenchError: the file is not of the schema. It may have taken hours, so it is not replaced.
    """
    try:
        kept: dict[str, Any] = read_json(path, schema, "remove it, and the run is made again", nan=True)
    except FileNotFoundError:
        kept = make()
        path.parent.mkdir(exist_ok=True)
        write_file(path, json.dumps(kept, indent=1))
    return kept
