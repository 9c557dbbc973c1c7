"""Precision of a bfloat16 policy's parameters: float32 while they are trained, bfloat16 otherwise."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import torch
from torch import nn


class Precision:
    """Keep trainable parameters of a bfloat16 policy in float32 and frozen ones in bfloat16.

    A bfloat16 weight near 1 has steps of 1/128, so an update at a learning rate of 5e-5 rounds to none. As pi0.5's
    reference implementation does, trained weights are float32 and autocast rounds them for each pass; frozen weights,
    and all of a policy that only acts, stay in the bfloat16 that LeRobot gives them.

    Args:
        parameters: all of the module's, as LeRobot has cast them.
    """

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self._narrow = [parameter for parameter in parameters if parameter.dtype == torch.bfloat16]

    def settle(self) -> None:
        """Convert trainable parameters to float32 and frozen ones to bfloat16."""
        for parameter in self._narrow:
            parameter.data = parameter.data.to(torch.float32 if parameter.requires_grad else torch.bfloat16)

    def narrowed(self) -> dict[nn.Parameter, torch.dtype]:
        """Return the parameters that are float32 now and bfloat16 in a policy that only acts, with that type."""
        return {parameter: torch.bfloat16 for parameter in self._narrow if parameter.dtype == torch.float32}

    def computing(self, device: torch.device) -> contextlib.AbstractContextManager[object]:
        """Return the context of a pass: autocast to bfloat16 while weights are float32."""
        if any(parameter.dtype == torch.float32 for parameter in self._narrow):
            return torch.autocast(device.type, dtype=torch.bfloat16)
        return contextlib.nullcontext()
