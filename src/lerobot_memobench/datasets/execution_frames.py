"""A dataset of LeRobot's without the frames of its prompts, in which actions have no effect.

LeRobot draws its samples, and looks back from them, within the bounds that a dataset's metadata tell of each episode.
Here they begin at the first execution frame, which the column ``observation.phase`` tells: it is there in generated,
converted and downloaded datasets, and LeRobot's dataset tools keep it.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Subset

from lerobot_memobench.protocol import CLOCK, EXECUTION, OBS_PHASE

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

COLUMNS = {*CLOCK, "simple_subgoal"}
"""What a dataset of ours has: a phase alone may be anybody's."""
BEGIN, END = "dataset_from_index", "dataset_to_index"


def leave_out_prompts(dataset: Any) -> int | None:
    """Move the bounds of a dataset's episodes to their execution; return how many frames that leaves out.

    Args:
        dataset: LeRobot's, opened to be read. One without our columns stays as it is. Of one that is streamed, the
            frames of prompts are passed over as they come: None, nobody knows how many there will be.
    """
    if not set(dataset.meta.features) >= COLUMNS:
        return 0
    if not hasattr(dataset.hf_dataset, "data"):
        # What LeRobot looks back to in the stream then ends where the execution begins.
        dataset.hf_dataset = dataset.hf_dataset.filter(_acts, input_columns=[OBS_PHASE])
        return None
    episodes = dataset.meta.episodes
    begin, end = (np.array(episodes[name], dtype=np.int64) for name in (BEGIN, END))
    acting = _column(dataset, OBS_PHASE) == EXECUTION
    starts = first_frames(begin, end, np.sort(_column(dataset, "index")[acting]))
    starts = np.where(np.isin(np.arange(len(begin)), _column(dataset, "episode_index")), starts, begin)  # those opened
    dataset.meta.episodes = episodes.remove_columns(BEGIN).add_column(BEGIN, starts)
    return int((starts - begin).sum())


def _acts(phase: float) -> bool:
    return phase == EXECUTION


def first_frames(begin: NDArray[np.int64], end: NDArray[np.int64], acting: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return each episode's first execution frame (E,), its end where it has none.

    Args:
        begin: (E,) first frames of the episodes. end: (E,) the frames after their last.
        acting: all execution frames, ascending.
    """
    found: NDArray[np.int64] = np.minimum(np.append(acting, end.max(initial=0))[acting.searchsorted(begin)], end)
    return found


def _column(dataset: Any, name: str) -> NDArray[np.int64]:
    column: NDArray[np.int64] = dataset.hf_dataset.data.column(name).to_numpy()
    return column


class ExecutionFrames(Subset[Any]):
    """The execution frames of a dataset, one by one: LeRobot walks through a held-out part without its bounds.

    Attributes:
        hf_dataset: the tasks of these frames, where LeRobot looks for them.
    """

    def __init__(self, dataset: LeRobotDataset) -> None:
        acting = np.flatnonzero(_column(dataset, OBS_PHASE) == EXECUTION)
        super().__init__(dataset, acting.tolist())
        tasks = dataset.hf_dataset.data.table.select(["task_index"])
        self.hf_dataset = SimpleNamespace(data=tasks.take(acting))
