"""Freed memory is kept for the next update instead of going back to the system and coming anew, page by page."""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # of glibc's malloc.h
_MORE = 256 << 20
"""What is asked for at once, bytes."""


def keep_freed_memory() -> None:
    """Let this process's malloc hold on to what is freed; nothing where the C library is not glibc.

    An update frees and takes some hundred MB: without the pages' faults a small policy's took 16 % less, and one of
    eyes, whose pictures alone were mapped anew each time, too (benchmarks/eyes_update.py).
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    for parameter, value in ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, _MORE)):
        libc.mallopt(parameter, value)
