"""How the functions of this package are compiled: for speed, and to equal bits on every machine.

Only additions, products, quotients and square roots are used, which IEEE 754 fixes to the bit, and none may be fused,
put in another order or replaced by a reciprocal. A compiled function calls none of another file: numba's cache
notices changes of the file of a function alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"nnan", "ninf", "nsz"},  # infinities and NaN never come up; these flags change no other bit
}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call, kept for later processes where there is a place for it."""
    try:
        made: Callable[..., Any] = njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # neither next to the source nor in the user's cache folder may be written
        made = njit(**_OPTIONS)(function)
    return made
