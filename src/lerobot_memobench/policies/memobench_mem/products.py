"""Speed on a CPU: factors of products in bfloat16 where that is quicker, exact ones inside, freed memory that is kept.

Settings of products are torch's and the process's, so each is on within a pass only, forward or backward.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor


def quicker_in_bfloat16() -> bool:
    """Return whether this CPU is quicker by instructions for products in bfloat16; not where torch cannot tell.

    It follows from the instructions and from no stopwatch: the same machine learns the same, however busy it is.
    By ``avx512_bf16`` an AMD EPYC made twice as many products a second as in float32; an Intel Xeon without AMX, which
    alone has ``avx512_fp16`` beside it, no more.
    """
    # LeRobot takes torch from 2.7 on, which could not be asked yet.
    known: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()
    return known.get("amx_bf16", False) or (known.get("avx512_bf16", False) and not known.get("avx512_fp16", False))


@contextmanager
def quick_products() -> Iterator[None]:
    """While this lasts, round the factors of products to bfloat16, if that is quicker on this CPU.

    Weights, gradients, sums and all that is no product stay float32. Attention in one kernel, whose many small
    products suffer, is left out; where it is asked for (`network.attend_fused`) its products are exact.
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


@contextmanager
def exact_products() -> Iterator[None]:
    """While this lasts, products are those of a rollout, whatever `quick_products` rounds them to.

    A memory that chooses by comparing then chooses the same; and products as small as these are quicker.
    """
    products: Any = getattr(torch.backends.mkldnn, "matmul", None)  # torch has had it since 2.9
    if products is None or products.fp32_precision != "bf16":
        yield
        return
    fused = torch.backends.cuda.flash_sdp_enabled()
    products.fp32_precision = "ieee"
    torch.backends.cuda.enable_flash_sdp(True)
    try:
        yield
    finally:
        products.fp32_precision = "bf16"
        torch.backends.cuda.enable_flash_sdp(fused)


def exact_gradients(made: Tensor) -> None:
    """Let the gradients of the one operation that made a tensor be computed with `exact_products`."""
    if made.grad_fn is None:
        return
    computing = ExitStack()
    made.grad_fn.register_prehook(lambda _: computing.enter_context(exact_products()))
    made.grad_fn.register_hook(lambda *_: computing.close())


def quick_gradients(loss: Tensor) -> None:
    """Let a loss's backward pass be computed with `quick_products`."""

    def begin(_: Tensor) -> None:
        passing = ExitStack()
        passing.enter_context(quick_products())
        torch.autograd.Variable._execution_engine.queue_callback(passing.close)  # when the pass has ended

    if loss.requires_grad:
        loss.register_hook(begin)


_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # of glibc's malloc.h
_LARGEST = 32 << 20
"""What glibc allows at most of what it does not map one by one, bytes."""


def keep_freed_memory() -> None:
    """Let this process's malloc hold on to what is freed; nothing where the C library is not glibc.

    Else it goes back to the system and comes anew, page by page. A small policy's update frees and takes some hundred
    MB; without the pages' faults it took 16 % less.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    for parameter, value in ((_MMAP_THRESHOLD, _LARGEST), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 8 * _LARGEST)):
        libc.mallopt(parameter, value)
