"""Names of the published layout, and what is said of a file that does not keep to it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import refusing

IMAGE_NAMES = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}
"""Camera of this package -> dataset of the published layout."""

EXTRAS = ("seed", "referent", "variant", "success", "fixture_poses", "scene_hash", "satisfied_intervals", "digest")
"""Attributes of a demonstration that only this package writes."""

SUFFIX = "_demo.hdf5"

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Problem:
    """Something that cannot be used: ``file``, ``group`` ("" for the file as a whole) and why."""

    file: str
    group: str
    reason: str

    def __str__(self) -> str:
        return f"{self.file}{', ' + self.group if self.group else ''}: {self.reason}"


class Unusable(MemobenchError):
    """A file or group that is not in the layout; the message is the reason alone."""


def usable_or_named() -> AbstractContextManager[None]:
    """As `refusing`: whatever a file says, it ends only itself."""
    return refusing(lambda why: Unusable(f"what it says cannot be used ({why})"))


def truth_to_intervals(satisfied: NDArray[np.bool_]) -> list[list[list[int]]]:
    """Return where each column of a (T, K) truth is true, as [start, stop) pairs."""
    edges = np.diff(satisfied.astype(np.int8), axis=0, prepend=0, append=0)
    return [np.flatnonzero(column).reshape(-1, 2).tolist() for column in edges.T]


def truth_from_intervals(intervals: Sequence[Sequence[Sequence[int]]], length: int) -> NDArray[np.bool_]:
    """Undo `truth_to_intervals` for K checkpoints: (T, K)."""
    truth = np.zeros((length, len(intervals)), dtype=np.bool_)
    for k, pairs in enumerate(intervals):
        for start, stop in pairs:
            truth[start:stop, k] = True
    return truth
