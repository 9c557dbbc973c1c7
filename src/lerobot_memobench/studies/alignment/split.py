"""Of which tasks are a dataset's episodes, which of them are held out, and on which frames is a memory asked?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_memobench.datasets.lerobot_format.reading import STRANGER, list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import suite_of


@dataclass(frozen=True)
class Split:
    """A dataset's episodes.

    Attributes:
        tasks: names of its tasks, in order. referent: of all its episodes.
        task: (E,) number of each episode's task. held: (E,) whether it is held out.
    """

    tasks: tuple[str, ...]
    referent: str
    task: np.ndarray
    held: np.ndarray

    @property
    def trained(self) -> list[int]:
        """Numbers of the episodes to train on."""
        return [int(number) for number in np.flatnonzero(~self.held)]

    def frames(self, askable: np.ndarray, episodes: np.ndarray, count: int, *, held: bool) -> np.ndarray:
        """Return frames of the episodes that are held out, or of the others, at most ``count`` of each, evenly spaced.

        Args:
            askable: (N,) which frames may be taken. episodes: (E + 1,) first frame of each episode.
        """
        chosen = np.flatnonzero(self.held == held)
        own = (episodes[k] + np.flatnonzero(askable[episodes[k] : episodes[k + 1]]) for k in chosen)
        return np.concatenate([_spaced(frames, count) for frames in own])


def split_episodes(root: Path, held_out: int) -> Split:
    """Hold out the last ``held_out`` episodes of every task of a dataset.

    Raises:
        MemobenchError: it is none of this package, of several suites or referents, or a task has too few episodes.
    """
    records = [place.record for place in list_episodes(root)]
    known = [record for record in records if record is not None]
    if len(known) < len(records):
        raise MemobenchError(f"of the episode {records.index(None)} of {root}, {STRANGER}")
    kinds = {(suite_of(record.task_name), record.referent) for record in known}
    if len(kinds) != 1:
        raise MemobenchError(
            f"{root} holds demonstrations of {len(kinds)} kinds, told apart by suite and referent; a study rolls out "
            "by one of each, so give a dataset of one `memobench generate`"
        )
    ((_, referent),) = kinds
    tasks, task = np.unique([record.task_name for record in known], return_inverse=True)
    return Split(tuple(map(str, tasks)), referent, task, _last(task, tasks, held_out))


def _last(task: np.ndarray, names: np.ndarray, count: int) -> np.ndarray:
    """Return which episodes (E,) are among the last ``count`` of their task (E,)."""
    held = np.zeros(len(task), dtype=bool)
    for number, name in enumerate(names):
        own = np.flatnonzero(task == number)
        if len(own) <= count:
            raise MemobenchError(
                f"the task '{name}' has {len(own)} episodes and {count} are to be held out; generate more, or lower "
                "--held-out"
            )
        held[own[-count:]] = True
    return held


def _spaced(frames: np.ndarray, count: int) -> np.ndarray:
    """At most ``count`` of these frames, evenly spaced."""
    places = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return frames[places.round().astype(int)]
