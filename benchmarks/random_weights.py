"""A policy of random weights, at any size, in no more memory than its weights take: for tests and benchmarks.

Constructors would make every weight in float32 and cast it afterwards: at full size 17 GB that end as 10. Here the
policy is built without weights (on torch's meta device), and each weight is then made once, where and as it stays.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import VISION_SEED, seed_parameters
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy


def random_policy(config: MemobenchMemConfig, seed: int = 0) -> MemobenchMemPolicy:
    """Return a policy of random weights on ``config.device``; its modulation is zero, as a new policy's is."""
    device = torch.device(config.device or "cpu")
    config.device = "meta"
    with torch.device("meta"):
        policy = MemobenchMemPolicy(config, load_base=False)
    config.device = str(device)
    materialise(policy, device, seed)
    seeing = policy.model.paligemma_with_expert.paligemma.model
    for part in (seeing.vision_tower, seeing.multi_modal_projector):
        seed_parameters(part, VISION_SEED)
    return policy


def materialise(model: nn.Module, device: torch.device, seed: int) -> None:
    """Make the weights of a model on the meta device, module by module, in place and in the precision they have there.

    Matrices get entries of variance 1/fan_in, vectors and modulations zero.
    """
    generator = torch.Generator(device).manual_seed(seed)
    for name, module in model.named_modules():
        for parameter in module.parameters(recurse=False):
            made = torch.zeros_like(parameter, device=device, requires_grad=False)
            if made.ndim > 1 and not name.endswith(".modulation"):
                bound = (3 / made[0].numel()) ** 0.5
                made.uniform_(-bound, bound, generator=generator)
            # The same object as before, because optimisers and averages tell parameters apart by it.
            torch.utils.swap_tensors(parameter, nn.Parameter(made, parameter.requires_grad))
    fill_buffers(model, device)


def fill_buffers(model: nn.Module, device: torch.device) -> None:
    """Give the buffers of a model on the meta device what their modules put there."""
    for module in model.modules():
        for key, buffer in module.named_buffers(recurse=False):
            content = _buffer(module, key) if buffer.is_meta else buffer
            setattr(module, key, content.to(device, buffer.dtype))


def _buffer(module: Any, name: str) -> Tensor:
    """Return the content that one of pi0.5's modules gives to a buffer of its own."""
    if name in ("inv_freq", "original_inv_freq"):
        fresh: Tensor = type(module)(config=module.config).inv_freq
        return fresh
    if name == "embed_scale":
        return torch.tensor(module.scalar_embed_scale)
    assert name == "position_ids", f"the buffer {name} of {type(module).__name__} is unknown"
    return torch.arange(int(module.num_positions)).expand(1, -1)
