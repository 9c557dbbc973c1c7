"""Where a CPU is quicker in bfloat16, which eyes ask before they learn by torch's autocast, and policies by products.

With `quick_products` weights, gradients, sums and all that is no product stay float32. A policy with eyes does without:
it is quicker by attention in one kernel (`fused_attention`). The setting is torch's and the process's, so it is on
within a pass only, forward or backward: what another policy computes in between computes as everywhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache

import torch
from torch import Tensor

INSTRUCTIONS = ("avx512_bf16", "amx_bf16")
CLEARLY = 0.8
"""Share of float32's time that products in bfloat16 may take at most: the same machine decides the same each time."""


@cache
def quicker_in_bfloat16() -> bool:
    """Return whether this CPU has instructions for products in bfloat16 and is clearly quicker by them; not where torch
    cannot tell.

    It is tried once, in some 70 ms: of two CPUs with ``avx512_bf16`` an AMD EPYC made twice as many a second as in
    float32, an Intel Xeon without AMX no more.
    """
    # LeRobot takes torch from 2.7 on, which could not be asked yet.
    known: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()
    if not any(known.get(name, False) for name in INSTRUCTIONS):
        return False
    products = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]  # torch sets it late
    before, seconds = products.fp32_precision, dict.fromkeys(("ieee", "bf16"), float("inf"))
    try:
        for precision in [*seconds] * 6:
            products.fp32_precision = precision
            seconds[precision] = min(seconds[precision], _seconds())
    finally:
        products.fp32_precision = before
    return seconds["bf16"] < CLEARLY * seconds["ieee"]


def _seconds() -> float:
    """Return how long a product takes."""
    left, right = torch.ones(1024, 512), torch.ones(512, 512)
    start = time.perf_counter()
    left @ right
    return time.perf_counter() - start


@contextmanager
def quick_products() -> Iterator[None]:
    """While this lasts, round the factors of products, if that is quicker; attention in one kernel, whose many small
    ones suffer, is left out.
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


def quick_gradients(loss: Tensor) -> None:
    """Let a loss's backward pass be computed with `quick_products`."""

    def begin(_: Tensor) -> None:
        passing = ExitStack()
        passing.enter_context(quick_products())
        torch.autograd.Variable._execution_engine.queue_callback(passing.close)  # when the pass has ended

    if loss.requires_grad:
        loss.register_hook(begin)
