"""Compile the functions of this package with bit-equal results on every machine.

Kernels use additions, products, quotients and square roots only, which IEEE 754 defines to the bit. Fusing, reordering
and reciprocal approximations are disabled. A compiled function must not call one of another file, because numba's cache
checks changes of a function's own file only.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"nnan", "ninf", "nsz"},  # infinities and NaN do not occur; these flags change no other bit
}


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile a function at its first call, with other options of numba if given; cache it on disk if possible."""
    options = {**_OPTIONS, **options}
    try:
        made: Any = njit(cache=True, **options)(function)
    except RuntimeError:  # neither the source folder nor the user's cache folder is writable
        return njit(**options)(function)
    _discard_unreadable_index(made._cache._cache_file)
    return made


def _discard_unreadable_index(cache_file: Any) -> None:
    """Remove the index of a function's cache if it cannot be read.

    Numba imports the classes of arguments before it compares the time of the source file, and fails if they moved.
    """
    try:
        cache_file._load_index()
    except Exception:
        Path(cache_file._index_path).unlink(missing_ok=True)
