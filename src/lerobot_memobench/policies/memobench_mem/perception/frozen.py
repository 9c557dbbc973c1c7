"""Frozen weights: drawn from a fixed seed where none are given, and told apart by a hash."""

from __future__ import annotations

import hashlib

import torch
from torch import nn

VISION_SEED = 20_250_705  # weights of an image tower for which none were given


def seed_parameters(module: nn.Module, seed: int) -> None:
    """Draw a module's weights from a fixed seed, the same on every machine: matrices ~ N(0, 1/fan_in), biases 0.

    Norm weights are one. The image tower gets these when no weights are given, so a cache made today agrees with a
    policy built tomorrow.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in sorted(module.named_parameters()):
            if parameter.is_meta:
                continue
            if parameter.ndim == 1:
                parameter.fill_(0.0 if name.endswith("bias") else 1.0)
            else:
                fan_in = parameter[0].numel()
                noise = torch.randn(parameter.shape, generator=generator) / fan_in**0.5
                parameter.copy_(noise)


def fingerprint(modules: dict[str, nn.Module]) -> str:
    """Short hash of names, shapes and values of the modules' parameters."""
    digest = hashlib.blake2b(digest_size=12)
    for prefix, module in sorted(modules.items()):
        for name, parameter in sorted(module.named_parameters()):
            digest.update(f"{prefix}.{name}{tuple(parameter.shape)}".encode())
            digest.update(parameter.detach().to("cpu", torch.float32).contiguous().numpy().tobytes())
    return digest.hexdigest()
