"""The moving average of the trained weights. A checkpoint's model is the average; another file holds the weights."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import as_trained, checkpoint_file, undamaged_tensors
from lerobot_memobench.policies.memobench_mem.checkpoints import read_tensors, restarted

logger = logging.getLogger(__name__)

TRAINING_FILE = "training_weights.safetensors"


class WeightAverage:
    """Trained weights, their average and the number of averaged updates, for each parameter.

    The average is kept outside the module, so that optimiser, DDP and ``state_dict`` do not see it; torch's
    ``AveragedModel`` is a copy of the module with one number of updates for all parameters. The decay grows from 0.1 to
    the given value as (1 + n) / (10 + n) over the first updates n of a parameter, so that the average of a short run
    is not dominated by the initial weights; after 9,000 updates it is 0.999. Averages are always float32, because
    bfloat16 cannot hold steps of a thousandth.

    Attributes:
        parameters: name -> trained parameter. average: name -> its average. counts: name -> number of its updates.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.decay, self.parameters = decay, dict(parameters)
        self.counts = dict.fromkeys(self.parameters, 0)
        self.average = {name: weight.detach().to(torch.float32, copy=True) for name, weight in self.parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        """Move the average towards the current weights by one step."""
        for count in set(self.counts.values()):
            names = [name for name, updates in self.counts.items() if updates == count]
            decay = min(self.decay, (1 + count) / (10 + count))
            weights = [self.parameters[name].detach().to(torch.float32) for name in names]
            torch._foreach_lerp_([self.average[name] for name in names], weights, 1.0 - decay)
        self.counts = {name: updates + 1 for name, updates in self.counts.items()}

    @contextmanager
    def applied(self, dtypes: Mapping[nn.Parameter, torch.dtype] | None = None) -> Iterator[None]:
        """Set the parameters to the average inside the block, some in other ``dtypes``; float32 ones are not copied."""
        trained = {name: parameter.data for name, parameter in self.parameters.items()}
        try:
            for name, parameter in self.parameters.items():
                parameter.data = self.average[name].to((dtypes or {}).get(parameter, parameter.dtype))
            yield
        finally:
            for name, parameter in self.parameters.items():
                parameter.data = trained[name]

    def save(self, folder: Path) -> None:
        """Write the trained weights, and the averages that the precision of the model's file would round."""
        tensors = {f"weights.{name}": parameter.detach().contiguous() for name, parameter in self.parameters.items()}
        for name, parameter in self.parameters.items():
            if parameter.dtype != torch.float32:
                tensors[f"average.{name}"] = self.average[name]
        longest = max(self.counts.values(), default=0)
        other_counts = {f"updates.{name}": str(count) for name, count in self.counts.items() if count != longest}
        folder.mkdir(parents=True, exist_ok=True)
        save_file(tensors, folder / TRAINING_FILE, metadata={"updates": str(longest), **other_counts})

    @torch.no_grad()
    def restore(self, path: Path, names: Collection[str]) -> list[str]:
        """Restore weights, averages and numbers of updates of these parameters in a module that holds the average.

        Return the parameters without a saved state, whose average starts at their present weights. A file that cannot
        be read, or does not fit, is refused.
        """
        with undamaged_tensors(path), safe_open(path, framework="pt") as file:
            metadata = file.metadata()
        tensors: Mapping[str, Tensor] = read_tensors(path)
        saved = {name: tensors[f"weights.{name}"] for name in names if f"weights.{name}" in tensors}
        for name, weights in saved.items():
            parameter = self.parameters[name]
            if weights.shape != parameter.shape:
                raise MemobenchError(
                    f"{path} holds '{name}' in another shape than this policy; copy the checkpoint again"
                )
            average = tensors.get(f"average.{name}", parameter.detach())  # else the model's file holds it exactly
            self.average[name] = average.to(parameter.device, torch.float32, copy=True)
            self.counts[name] = int(metadata.get(f"updates.{name}", metadata["updates"]))
            parameter.copy_(weights.to(parameter.device))
        return [name for name in self.parameters if name not in saved]


def begin_average(policy: Any) -> WeightAverage | None:
    """Return the average of a policy in training; None without one (``ema_decay=0``, adapters).

    A policy loaded from a checkpoint holds the average. Its trained weights are restored, and the average continues;
    for parts that are initialised again, or that the checkpoint did not train, it starts at their weights.
    """
    config = policy.config
    if not config.ema_decay or config.use_peft:
        return None
    average = WeightAverage(policy.trained_parameters(), config.ema_decay)
    source, revision = config.pretrained_path, config.pretrained_revision
    path = None if source is None else checkpoint_file(source, TRAINING_FILE, revision)
    if path is None:
        return average
    trained: Any = as_trained(source, config, revision)
    new = average.restore(path, average.parameters.keys() - restarted(policy, trained))
    if new:
        logger.info("the average continues from '%s'; that of %s starts again", source, ", ".join(new))
    return average
