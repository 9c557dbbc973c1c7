"""Training samples are execution frames: the prompt, whose actions have no effect, takes no place in a batch.

lerobot-train draws the frames of all episodes uniformly, each once per epoch, in an order that seed and epoch decide,
and leaves no say in where an episode begins. What it does ask the configuration for is how many frames to drop at the
end; our answer is 0 and carries, for its sampler, where each episode's execution begins. The sampler is LeRobot's, and
any other answer leaves it as it was. Histories still hold the prompt, because they come from the memory cache.
"""

from __future__ import annotations

import functools
import inspect
from typing import Any

import numpy as np
from lerobot.datasets.sampler import EpisodeAwareSampler

from lerobot_memobench.datasets.demonstration import PROMPT
from lerobot_memobench.datasets.execution_frames import first_frames


class FromStarts(int):
    """How many frames to drop at the end of each episode, and from which frame on (E,) to draw."""

    starts: np.ndarray

    @classmethod
    def of(cls, starts: np.ndarray) -> FromStarts:
        """Return 0, with the first frames to draw; LeRobot's sampler understands it from now on."""
        _teach(EpisodeAwareSampler)
        found = cls(0)
        found.starts = starts
        return found


def execution_starts(episodes: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return the first execution frame of each episode (E,); its end where there is none.

    Args:
        episodes: (E + 1,) first frame of each episode, and the number of frames N. phase: (N,) 0 in the prompt.
    """
    return first_frames(episodes[:-1], episodes[1:], np.flatnonzero(phase != PROMPT))


def _teach(sampler: type[Any]) -> None:
    """Let a sampler begin its episodes where its ``drop_n_last_frames`` says, if that says so."""
    original = sampler.__init__
    if hasattr(original, "__wrapped__"):
        return
    signature = inspect.signature(original)

    @functools.wraps(original)
    def init(self: Any, *args: Any, **named: Any) -> None:
        asked = signature.bind(self, *args, **named)
        dropped = asked.arguments.get("drop_n_last_frames", 0)
        if isinstance(dropped, FromStarts):
            asked.arguments["dataset_from_indices"] = dropped.starts
        original(*asked.args, **asked.kwargs)

    sampler.__init__ = init
