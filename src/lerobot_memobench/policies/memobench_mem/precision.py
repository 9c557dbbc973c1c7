"""Numbers of a bfloat16 policy: what learns is kept in float32, and computed with in bfloat16.

A bfloat16 weight near 1 has steps of 1/128, so an update at a learning rate of 5e-5 rounds to none. As pi0.5's
reference implementation does, trained weights are float32 and autocast rounds them for each pass; what is frozen, and
all of a policy that only acts, stays in the bfloat16 that LeRobot gives it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import torch
from torch import nn


class Precision:
    """The parameters of a module that are bfloat16 while nothing learns.

    Args:
        parameters: all of the module's, as LeRobot has cast them.
    """

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self._narrow = [parameter for parameter in parameters if parameter.dtype == torch.bfloat16]

    def settle(self) -> None:
        """Widen what learns to float32; narrow what does not (any more)."""
        for parameter in self._narrow:
            parameter.data = parameter.data.to(torch.float32 if parameter.requires_grad else torch.bfloat16)

    def narrowed(self) -> dict[nn.Parameter, torch.dtype]:
        """Return those that are wider now than they are in a policy that only acts, and their width there."""
        return {parameter: torch.bfloat16 for parameter in self._narrow if parameter.dtype == torch.float32}

    def computing(self, device: torch.device) -> contextlib.AbstractContextManager[object]:
        """Return the context to compute in: autocast while weights are wider than what is computed with."""
        if any(parameter.dtype == torch.float32 for parameter in self._narrow):
            return torch.autocast(device.type, dtype=torch.bfloat16)
        return contextlib.nullcontext()
