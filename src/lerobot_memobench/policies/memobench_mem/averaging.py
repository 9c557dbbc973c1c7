"""Exponential moving average of the trained weights, which evaluation uses (paper: decay 0.999)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class WeightAverage:
    """Average of a set of parameters, kept outside the module so that no optimiser, DDP or ``state_dict`` sees it.

    The decay grows from 0.1 to its value as (1 + n) / (10 + n) over the first updates n, so that a short run does not
    evaluate its initial weights; after 9,000 updates it is the given 0.999. Averages are float32 whatever the
    parameters are, because bfloat16 cannot hold steps of a thousandth.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self.parameters = dict(parameters)
        self.average: dict[str, Tensor] = {
            name: parameter.detach().to(torch.float32, copy=True) for name, parameter in self.parameters.items()
        }
        self._cast: dict[str, Tensor] = {}  # the average in another precision, until it moves on

    @torch.no_grad()
    def update(self) -> None:
        """Move the average towards the current weights by one step."""
        self._cast.clear()
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        self.updates += 1
        weights = [parameter.detach().to(torch.float32) for parameter in self.parameters.values()]
        torch._foreach_lerp_([self.average[name] for name in self.parameters], weights, 1.0 - decay)

    @contextmanager
    def applied(self, dtypes: Mapping[nn.Parameter, torch.dtype] | None = None) -> Iterator[None]:
        """Let the module hold the average inside the block.

        Nothing is copied for float32 parameters, and what is cast is cast once for all blocks until the next update:
        an evaluation enters one for every plan.

        Args:
            dtypes: parameters that are to hold the average in another precision than their own.
        """
        trained = {name: parameter.data for name, parameter in self.parameters.items()}
        try:
            for name, parameter in self.parameters.items():
                parameter.data = self._as(name, (dtypes or {}).get(parameter, parameter.dtype))
            yield
        finally:
            for name, parameter in self.parameters.items():
                parameter.data = trained[name]

    def keep(self) -> None:
        """Let the module hold the average for good."""
        for name, parameter in self.parameters.items():
            parameter.data = self.average[name]

    def _as(self, name: str, dtype: torch.dtype) -> Tensor:
        if self.average[name].dtype == dtype:
            return self.average[name]
        if name not in self._cast or self._cast[name].dtype != dtype:
            self._cast[name] = self.average[name].to(dtype)
        return self._cast[name]

    def state(self) -> tuple[dict[str, Tensor], dict[str, str]]:
        """Tensors and metadata for a safetensors file beside one that holds the averaged module.

        The trained weights, and the averages where the module's own precision would round them.
        """
        tensors = {f"weights.{name}": parameter.detach().contiguous() for name, parameter in self.parameters.items()}
        for name, parameter in self.parameters.items():
            if parameter.dtype != torch.float32:
                tensors[f"average.{name}"] = self.average[name]
        return tensors, {"updates": str(self.updates)}

    @torch.no_grad()
    def restore(self, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> list[str]:
        """Undo :meth:`state` in a module that holds the average: it goes on with the trained weights.

        Returns:
            Names of parameters that the state does not know; their average begins with what they are now.
        """
        self.updates = int(metadata["updates"])
        self._cast.clear()
        for name, parameter in self.parameters.items():
            if f"weights.{name}" not in tensors:
                continue
            device = parameter.device
            self.average[name] = tensors.get(f"average.{name}", parameter.detach()).to(device, torch.float32, copy=True)
            parameter.copy_(tensors[f"weights.{name}"].to(device))
        return [name for name in self.parameters if f"weights.{name}" not in tensors]
