"""Statistics of the frames that are drawn: prompts, in which nothing is done, do not count as actions of zero."""

from __future__ import annotations

from typing import Any

import numpy as np
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_memobench.datasets.feature_cache.reading import RecordedFrames

STILL = 0.01
"""Added to the standard deviations of actions, so that a number that hardly varies is not blown up to noise."""


def count_drawn_only(stats: dict[str, dict[str, Any]], frames: RecordedFrames, drawn: np.ndarray) -> None:
    """Replace LeRobot's statistics of states and actions by those of some of the frames (N,) bool, in place.

    They are what LeRobot then hands to every normaliser: a new policy's, and one that goes on from a checkpoint.
    """
    for key in (OBS_STATE, ACTION):
        stats[key] = get_feature_stats(frames.columns[key].numpy()[drawn], axis=0, keepdims=False)
    stats[ACTION]["std"] = stats[ACTION]["std"] + STILL
