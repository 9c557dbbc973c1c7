"""Trained weights and their moving average."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor, nn


class Averaged(NamedTuple):
    """State of one parameter in a checkpoint.

    Attributes:
        weights: trained weights. average: their average, None where the model's file holds it exactly.
        updates: number of updates in the average.
    """

    weights: Tensor
    average: Tensor | None
    updates: int


class WeightAverage:
    """Trained weights, their average and the number of averaged updates, for each parameter.

    The average is kept outside the module, so that optimiser, DDP and ``state_dict`` do not see it. Its decay grows
    from 0.1 to the given value as (1 + n) / (10 + n) over the first updates n of a parameter, so that a short run does
    not evaluate initial weights; after 9,000 updates it is 0.999. Averages are float32 whatever the parameters are,
    because bfloat16 cannot hold steps of a thousandth.

    Attributes:
        parameters: name -> trained parameter. average: name -> its average. counts: name -> number of its updates.
        whole: whether this process holds all of it (see `sharding.ShardedAverage`).
    """

    whole = True

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.decay = decay
        self.parameters: dict[str, nn.Parameter] = {}
        self.average: dict[str, Tensor] = {}
        self.counts: dict[str, int] = {}
        self._cast: dict[str, Tensor] = {}  # the average in another precision, until it moves on
        self.begin(parameters)

    @property
    def updates(self) -> int:
        """Number of updates of the parameter that has been averaged the longest."""
        return max(self.counts.values(), default=0)

    def begin(self, parameters: Mapping[str, nn.Parameter]) -> None:
        """Set the average of some parameters to their present weights, and their number of updates to 0."""
        self._cast.clear()
        for name, parameter in parameters.items():
            self.parameters[name], self.counts[name] = parameter, 0
            self.average[name] = parameter.detach().to(torch.float32, copy=True)

    @torch.no_grad()
    def update(self) -> None:
        """Move the average towards the current weights by one step."""
        self._cast.clear()
        for count in set(self.counts.values()):
            names = [name for name, updates in self.counts.items() if updates == count]
            decay = min(self.decay, (1 + count) / (10 + count))
            weights = [self.parameters[name].detach().to(torch.float32) for name in names]
            torch._foreach_lerp_([self.average[name] for name in names], weights, 1.0 - decay)
        self.counts = {name: updates + 1 for name, updates in self.counts.items()}

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
        """Return tensors and metadata of a safetensors file, next to one that holds the averaged module.

        The trained weights, and the averages where the module's own precision would round them. `states_of` reads them.
        """
        tensors = {f"weights.{name}": parameter.detach().contiguous() for name, parameter in self.parameters.items()}
        for name, parameter in self.parameters.items():
            if parameter.dtype != torch.float32:
                tensors[f"average.{name}"] = self.average[name]
        return tensors, self._metadata()

    def _metadata(self) -> dict[str, str]:
        others = {f"updates.{name}": str(count) for name, count in self.counts.items() if count != self.updates}
        return {"updates": str(self.updates), **others}

    @torch.no_grad()
    def restore(self, states: Mapping[str, Averaged]) -> list[str]:
        """Set the trained weights, averages and numbers of updates of a module that holds the average.

        Returns:
            Names of parameters without a state; their average begins with their present weights.
        """
        for name in states.keys() & self.parameters.keys():
            parameter, (weights, average, self.counts[name]) = self.parameters[name], states[name]
            held = parameter.detach() if average is None else average
            self.average[name] = held.to(parameter.device, torch.float32, copy=True)
            parameter.copy_(weights.to(parameter.device))
        self._cast.clear()
        return [name for name in self.parameters if name not in states]


def states_of(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> dict[str, Averaged]:
    """Return name -> state of each parameter of a `WeightAverage.state`."""
    names = [key.removeprefix("weights.") for key in tensors if key.startswith("weights.")]
    return {
        name: Averaged(
            tensors[f"weights.{name}"],
            tensors.get(f"average.{name}"),
            int(metadata.get(f"updates.{name}", metadata["updates"])),
        )
        for name in names
    }
