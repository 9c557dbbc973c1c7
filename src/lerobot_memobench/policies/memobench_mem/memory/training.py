"""The memory of training samples: a mechanism recalls it from the dataset's feature cache."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.datasets.feature_cache.reading import FrameLookup
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Frame, MemoryMechanism


class CachedEpisode:
    """The stored frames of one episode of a feature cache; see `EpisodeFrames`."""

    def __init__(self, cache: FrameLookup, episode: int) -> None:
        self.cache, self.episode = cache, episode

    def load(self, slots: Sequence[int]) -> list[Frame]:
        """Read these frames, and no others, from the cache's file."""
        tokens = self.cache.tokens(self.episode, slots)
        return [Frame(slot * self.cache.meta.stride, seen) for slot, seen in zip(slots, tokens.unbind(), strict=True)]


def recall_at(cache: FrameLookup, mechanism: MemoryMechanism, episode: int, frame: int) -> list[Frame]:
    """Return what ``mechanism`` reads at a frame of an episode, counted from its start."""
    return mechanism.recall(CachedEpisode(cache, episode), frame // cache.meta.stride)
