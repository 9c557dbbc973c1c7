"""Matrix products of float32 numbers computed in bfloat16 while a policy learns on a CPU: twice as many a second.

Weights, gradients, sums and all that is no product stay float32. A CPU without instructions for bfloat16 goes on in
float32: oneDNN asks it. The setting is torch's and the process's, so it is on from a forward pass to its update only:
what acts, or measures a loss, in between two updates computes as everywhere.
"""

from __future__ import annotations

import torch

_before: tuple[str, bool] | None = None


def begin_quick_products() -> None:
    """Round the factors of products from now on; attention in one kernel, whose many small ones suffer, is left out."""
    global _before
    if _before is None:
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
