"""Which episodes are held out, and on which frames is a memory asked?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.studies.alignment.frames import Frames
from lerobot_memobench.studies.alignment.settings import StudySettings


@dataclass(frozen=True)
class Split:
    """Frames of the dataset by their use, as global indices.

    Attributes:
        train: every frame of the training episodes.
        fit, test: execution frames of training and of held-out episodes, evenly spaced.
        episode: (N,) episode of every frame.
    """

    train: np.ndarray
    fit: np.ndarray
    test: np.ndarray
    episode: np.ndarray


def split_frames(frames: Frames, phase: np.ndarray, settings: StudySettings) -> Split:
    """Hold out the last episodes of every task; ``phase`` (N,) is 1 for the execution's frames.

    Raises:
        MemobenchError: a task has too few episodes.
    """
    held = _held_out(frames, settings.held_out)
    episode = np.repeat(np.arange(len(held)), np.diff(frames.episodes))

    def asked(held_out: bool) -> np.ndarray:
        """Execution frames, evenly spaced, of episodes that are held out or not."""
        chosen = np.flatnonzero(held == held_out)
        acting = (np.flatnonzero((episode == number) & (phase == 1)) for number in chosen)
        return np.concatenate([_spaced(own, settings.frames_per_episode) for own in acting])

    return Split(train=np.flatnonzero(~held[episode]), fit=asked(False), test=asked(True), episode=episode)


def _held_out(frames: Frames, count: int) -> np.ndarray:
    """(E,) bool: the last ``count`` episodes of every task."""
    task_of = np.array([frames.tasks[first] for first in frames.episodes[:-1]])
    held = np.zeros(len(task_of), dtype=bool)
    for task in np.unique(task_of):
        own = np.flatnonzero(task_of == task)
        if len(own) <= count:
            raise MemobenchError(
                f"the task '{frames.task_texts[int(task)]}' has {len(own)} episodes and {count} are to be "
                "held out; generate more, or lower --held-out"
            )
        held[own[-count:]] = True
    return held


def _spaced(frames: np.ndarray, count: int) -> np.ndarray:
    """At most ``count`` of these frames, evenly spaced."""
    places = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return frames[places.round().astype(int)]
