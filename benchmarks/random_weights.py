"""Make a policy with random weights at any size, for tests and benchmarks, without more memory than the weights need.

The constructor would allocate all weights in float32 and cast them later: 17 GB instead of 10 at full size. Here the
policy is built on torch's meta device; each weight is then allocated once, on its device and in its precision.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import VISION_SEED, seed_parameters
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy


def random_policy(config: MemobenchMemConfig, seed: int = 0) -> MemobenchMemPolicy:
    """Return a policy with random weights on ``config.device``; its modulation is zero, as in a new policy."""
    device = torch.device(config.device or "cpu")
    config.device = "meta"
    with torch.device("meta"):
        policy = MemobenchMemPolicy(config, load_base=False)
    config.device = str(device)
    materialise(policy, device, seed)
    vlm = policy.model.paligemma_with_expert.paligemma.model
    for part in (vlm.vision_tower, vlm.multi_modal_projector):
        seed_parameters(part, VISION_SEED)
    return policy


def materialise(model: nn.Module, device: torch.device, seed: int) -> None:
    """Allocate the weights of a meta-device model in place, each in its own precision.

    Entries of matrices have variance 1/fan_in; vectors and modulations are zero.
    """
    generator = torch.Generator(device).manual_seed(seed)
    for name, module in model.named_modules():
        for parameter in module.parameters(recurse=False):
            values = torch.zeros_like(parameter, device=device, requires_grad=False)
            if values.ndim > 1 and not name.endswith(".modulation"):
                bound = (3 / values[0].numel()) ** 0.5
                values.uniform_(-bound, bound, generator=generator)
            # Keep the object: optimisers and averages identify a parameter by it.
            torch.utils.swap_tensors(parameter, nn.Parameter(values, parameter.requires_grad))
    fill_buffers(model, device)


def fill_buffers(model: nn.Module, device: torch.device) -> None:
    """Fill the buffers of a meta-device model with the values that their modules compute."""
    for module in model.modules():
        for key, buffer in module.named_buffers(recurse=False):
            content = _buffer(module, key) if buffer.is_meta else buffer
            setattr(module, key, content.to(device, buffer.dtype))


def _buffer(module: Any, name: str) -> Tensor:
    """Return the values of a buffer of one of pi0.5's modules."""
    if name in ("inv_freq", "original_inv_freq"):
        fresh: Tensor = type(module)(config=module.config).inv_freq
        return fresh
    if name == "embed_scale":
        return torch.tensor(module.scalar_embed_scale)
    assert name == "position_ids", f"the buffer {name} of {type(module).__name__} is unknown"
    return torch.arange(int(module.num_positions)).expand(1, -1)
