"""Speed up an update on a CPU: round factors of matrix products to bfloat16, and keep freed memory.

The settings are torch's and the process's; `quick_products` applies to one update and ends with it.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def quicker_in_bfloat16() -> bool:
    """Return whether this CPU has instructions that make products in bfloat16 faster; False if torch cannot tell.

    It depends on the instructions and not on a measurement: the same machine learns the same, however busy it is.
    By ``avx512_bf16`` an AMD EPYC made twice as many products a second as in float32; an Intel Xeon without AMX, which
    alone has ``avx512_fp16`` beside it, no more.
    """
    # LeRobot takes torch from 2.7 on, which could not be asked yet.
    known: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()
    return known.get("amx_bf16", False) or (known.get("avx512_bf16", False) and not known.get("avx512_fp16", False))


@contextmanager
def quick_products() -> Iterator[None]:
    """Inside the block, round the factors of products to bfloat16, if that is faster on this CPU.

    Weights, gradients, sums and everything but products stay float32. The fused attention kernel, whose many small
    products suffer, is disabled; code that asks for it (`layers.attend`) computes exact products.
    """
    if not quicker_in_bfloat16():
        yield
        return
    products = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]  # torch sets it late
    before = products.fp32_precision, torch.backends.cuda.flash_sdp_enabled()  # of the CPU's kernel, too
    products.fp32_precision = "bf16"
    torch.backends.cuda.enable_flash_sdp(False)
    try:
        yield
    finally:
        products.fp32_precision, fused = before
        torch.backends.cuda.enable_flash_sdp(fused)


_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # of glibc's malloc.h
_LARGEST = 32 << 20
"""The largest threshold of mapped blocks that glibc allows, bytes."""


def keep_freed_memory() -> None:
    """Make this process's malloc keep freed memory; nothing on another C library than glibc.

    Otherwise it returns to the system and comes back page by page. A small policy's update frees and takes some hundred
    MB; without the page faults it took 16 % less time.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    for parameter, value in ((_MMAP_THRESHOLD, _LARGEST), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 8 * _LARGEST)):
        libc.mallopt(parameter, value)
