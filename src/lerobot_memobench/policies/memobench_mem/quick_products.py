"""Matrix products of float32 numbers computed in bfloat16 while a policy learns on a CPU: twice as many a second.

Weights, gradients, sums and all that is no product stay float32. Nothing changes on a CPU without instructions for
bfloat16, nor for a policy with eyes, which is quicker by attention in one kernel (`fused_attention`). The setting is
torch's and the process's, so it is on from a forward pass to its update only: what acts, or measures a loss, in between
two updates computes as everywhere.
"""

from __future__ import annotations

import torch

INSTRUCTIONS = ("avx512_bf16", "amx_bf16")
_before: tuple[str, bool] | None = None


def multiplies_bfloat16() -> bool:
    """Return whether this CPU has instructions for products in bfloat16; not where torch cannot tell."""
    # LeRobot takes torch from 2.7 on, which could not be asked yet.
    known: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(known.get(name, False) for name in INSTRUCTIONS)


def begin_quick_products() -> None:
    """Round the factors of products from now on; attention in one kernel, whose many small ones suffer, is left out."""
    global _before
    if _before is None and multiplies_bfloat16():
        products = torch.backends.mkldnn.matmul
        _before = products.fp32_precision, torch.backends.cuda.flash_sdp_enabled()  # of the CPU's kernel, too
        products.fp32_precision = "bf16"
        torch.backends.cuda.enable_flash_sdp(False)


def end_quick_products() -> None:
    """Put everything back, if they had begun."""
    global _before
    if _before is not None:
        torch.backends.mkldnn.matmul.fp32_precision, fused = _before
        torch.backends.cuda.enable_flash_sdp(fused)
        _before = None
