"""What a process of its own is asked in these tests; it must be importable there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def opened() -> Iterator[list[int]]:
    """Open something."""
    yield []


def remember(thing: list[int], number: int) -> list[int]:
    """Change what was opened."""
    thing.append(number)
    return thing


def threads(thing: list[int]) -> list[str | None]:
    """Return what the process was told."""
    return [os.environ.get(name) for name in ("OMP_NUM_THREADS", "LP_NUM_THREADS", "MEMOBENCH_THREADS")]


def fail(thing: list[int]) -> None:
    """Fail."""
    raise ValueError("no")
