"""Exact products inside an update whose other products are rounded (`training.loop.quick_products`)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor


@contextmanager
def exact_products() -> Iterator[None]:
    """Inside the block, compute products as in a rollout, without rounding their factors.

    A memory that chooses by comparison then chooses as in a rollout; and such small products are faster.
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
