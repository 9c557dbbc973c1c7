"""Checkpoints of the policy: what may be loaded into it, and its averaged weights beside the trained ones."""

from __future__ import annotations

import logging
from pathlib import Path

from lerobot.configs import PreTrainedConfig
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import CONFIG_FILE, read_json
from lerobot_memobench.policies.memobench_mem.averaging import WeightAverage
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory_pi05 import MemoryPI05
from lerobot_memobench.policies.memobench_mem.weights import (
    TRAINING_FILE,
    checkpoint_file,
    load_exactly,
)

logger = logging.getLogger(__name__)


def read_config(source: str | Path, config: PreTrainedConfig | None, revision: str | None) -> MemobenchMemConfig:
    """Return the configuration that a checkpoint is loaded with: ``config``, or its own.

    Raises:
        MemobenchError: it is another policy's, or was trained through other eyes.
    """
    found = PreTrainedConfig.from_pretrained(source, revision=revision) if config is None else config
    if not isinstance(found, MemobenchMemConfig):
        raise MemobenchError(
            f"'{source}' is a '{found.type}' checkpoint and not memobench_mem; to start from pi0.5's weights "
            "pass --policy.type=memobench_mem --policy.base_weights=<checkpoint>."
        )
    path = checkpoint_file(source, CONFIG_FILE, revision)
    held = None if path is None else read_json(path).get("eyes")
    if held and found.eyes and found.eyes != held and not found.sees_objects:
        raise MemobenchError(
            f"--policy.eyes={found.eyes} cannot be followed: '{source}' was trained through the tower of '{held}' and "
            "holds it; leave eyes out, or train anew."
        )
    return found


def load_weights(policy: nn.Module, path: Path, source: str | Path, *, remembers: bool) -> None:
    """Load the weights of checkpoint ``source`` into a policy of this kind; its alignment heads may be missing.

    Raises:
        MemobenchError: they do not fit, or bring no memory to a policy that ``remembers``.
    """
    weights = load_file(path)
    if remembers and not any(name.startswith("model.memory.") for name in weights):
        raise MemobenchError(
            f"'{source}' holds weights without a memory; to start from pi0.5's weights pass "
            "--policy.base_weights=<checkpoint> instead of a pretrained path."
        )
    # A run may change the objective of the one it goes on from; its heads then start anew.
    heads = {name for name in policy.state_dict() if name.startswith("alignment.")}
    load_exactly(policy, weights, source, optional=heads)


def load_base_weights(model: MemoryPI05, weights: dict[str, Tensor], source: str) -> None:
    """Start from pi0.5's weights; only the memory's own parameters stay at their initial values."""
    placed = {model.place_of(name.removeprefix("model.")): tensor for name, tensor in weights.items()}
    load_exactly(model, placed, source, optional=set(model.memory_parameters()))


def save_training_weights(average: WeightAverage, folder: Path) -> None:
    """Write the trained weights beside a model file that holds their average, for going on."""
    tensors, metadata = average.state()
    save_file(tensors, folder / TRAINING_FILE, metadata=metadata)


def restore_average(average: WeightAverage, source: str | Path, revision: str | None) -> WeightAverage | None:
    """Go on with a checkpoint's trained weights and their average; None where it has none.

    What the checkpoint did not train (another objective's head, a part that was frozen) begins its average anew.
    """
    path = checkpoint_file(source, TRAINING_FILE, revision)
    if path is None:
        return None
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    new = average.restore(load_file(path), metadata)
    if new:
        logger.info("The average goes on from '%s'; that of %s begins anew.", source, ", ".join(new))
    return average
