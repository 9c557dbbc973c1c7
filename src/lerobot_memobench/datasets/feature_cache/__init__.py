"""Memory cache: what a memory policy would otherwise recompute for every sample, made once beside the dataset.

It holds the pooled tokens of the frozen vision tower for every ``stride``-th frame of one camera, the embedding of
every subgoal text, and per frame its phase and subgoal. Everything large is memory-mapped, so training gathers 32
frames of history without decoding a video (delta timestamps are fixed offsets and cannot say "spread over the episode
so far"). For a policy with eyes all tokens of every picture of a camera are a cache, too.
"""

from lerobot_memobench.datasets.feature_cache.building import build_memory_cache
from lerobot_memobench.datasets.feature_cache.decoding import FrameReader, frame_reader
from lerobot_memobench.datasets.feature_cache.encoding import FrameEncoder, Progress
from lerobot_memobench.datasets.feature_cache.frame_table import resolve_subgoals
from lerobot_memobench.datasets.feature_cache.layout import (
    FOLDER,
    CacheMeta,
    dataset_fingerprint,
    find_cache,
    read_meta,
)
from lerobot_memobench.datasets.feature_cache.lookup import FrameLookup
from lerobot_memobench.datasets.feature_cache.reading import MemoryCache
from lerobot_memobench.datasets.feature_cache.recorded import RecordedFrames, RecordedTexts, read_recorded
from lerobot_memobench.datasets.feature_cache.tables import TextEncoder

__all__ = [
    "FOLDER",
    "CacheMeta",
    "FrameEncoder",
    "FrameLookup",
    "FrameReader",
    "MemoryCache",
    "Progress",
    "RecordedFrames",
    "RecordedTexts",
    "TextEncoder",
    "build_memory_cache",
    "dataset_fingerprint",
    "find_cache",
    "frame_reader",
    "read_meta",
    "read_recorded",
    "resolve_subgoals",
]
