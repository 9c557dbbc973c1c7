"""Functions for the process of these tests, which must import them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def opened() -> Iterator[list[int]]:
    """Open something."""
    yield []


def remember(thing: list[int], number: int) -> list[int]:
    """Change the opened object."""
    thing.append(number)
    return thing


def threads(thing: list[int]) -> list[str | None]:
    """Return the arguments of the process."""
    return [os.environ.get(name) for name in ("OMP_NUM_THREADS", "LP_NUM_THREADS", "MEMOBENCH_THREADS")]


def fail(thing: list[int]) -> None:
    """Fail."""
    raise ValueError("no")
