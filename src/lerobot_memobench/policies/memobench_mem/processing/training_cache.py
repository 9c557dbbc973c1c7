"""The memory cache of the dataset that is being trained on.

LeRobot rebuilds a saved pipeline (resume, fine-tuning) without telling it the dataset; the policy, which is always
told and is always made first, leaves its checked cache here.
"""

from __future__ import annotations

from lerobot_memobench.datasets.memory_cache import MemoryCache
from lerobot_memobench.errors import MemobenchError

_training_cache: MemoryCache | None = None


def set_training_cache(cache: MemoryCache | None) -> None:
    """Called by the policy with the cache of the dataset it is about to train on."""
    global _training_cache
    _training_cache = cache


def training_cache() -> MemoryCache | None:
    """Return the cache of the dataset being trained on; None while nothing is."""
    return _training_cache


def require_cache(own: MemoryCache | None) -> MemoryCache:
    """Return the cache a step was given, or else that of the dataset being trained on.

    Raises:
        MemobenchError: there is neither.
    """
    cache = own or _training_cache
    if cache is None:
        raise MemobenchError(
            "The preprocessor of memobench_mem has no memory cache to look up history in: make the policy with its "
            "dataset_meta first, or give GatherMemoryProcessorStep a cache."
        )
    return cache
