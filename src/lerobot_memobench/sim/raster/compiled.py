"""Compile the functions of this package with bit-equal results on every machine.

Kernels use additions, products, quotients and square roots only, which IEEE 754 defines to the bit. Fusing, reordering
and reciprocal approximations are disabled. A compiled function must not call one of another file, because numba's cache
checks changes of a function's own file only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"nnan", "ninf", "nsz"},  # infinities and NaN do not occur; these flags change no other bit
}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call; cache it on disk if possible."""
    try:
        made: Callable[..., Any] = njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # neither the source folder nor the user's cache folder is writable
        made = njit(**_OPTIONS)(function)
    return made
