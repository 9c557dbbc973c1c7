"""A small memory policy with its processors and samples, as `lerobot train` makes them, and the frames it remembers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.frames import sample_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES, STEPS, Histories
from lerobot_memobench.policies.memobench_mem.sizes import FLOW_MATCHING
from lerobot_memobench.training.data import Training, open_datasets, open_training

CHUNK = 6


def small_config(frames: int = 8, **fields: Any) -> MemobenchMemConfig:
    """Return a configuration with short chunks, few denoising steps and, in memories of frames, few frames.

    Args:
        frames: number of frames that a chunk reads.
    """
    if fields.get("memory") == "none":
        fields.pop("memory_stride", None)
    read = MemobenchMemConfig(device="cpu", **fields)
    usual: dict[str, Any] = {"chunk_size": CHUNK, "n_action_steps": CHUNK}
    if read.objective == FLOW_MATCHING:
        usual["num_inference_steps"] = 2
    if read.memory in ("frames", "subgoal"):
        usual["memory_settings"] = {"frames": frames}
    return MemobenchMemConfig(device="cpu", push_to_hub=False, **usual | fields)


def draw_modulation(module: torch.nn.Module, std: float = 0.2) -> None:
    """Draw the layers of a memory's modulation, which start at zero, so that memory has an effect."""
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if ".modulation." in name:
                parameter.normal_(std=std)


def open_small_training(root: Path, config: MemobenchMemConfig) -> Training:
    """Return the training of a policy on a dataset; weights are drawn from seed 0."""
    whole = TrainPipelineConfig(DatasetConfig("memobench/synthetic", root=str(root)), policy=config)
    datasets = open_datasets(whole)
    torch.manual_seed(0)
    return open_training(whole, datasets)


def made_for_training(root: Path, **fields: Any):  # type: ignore[no-untyped-def]
    """Return policy, preprocessor, postprocessor and samples, as `lerobot train` makes them."""
    training = open_small_training(root, small_config(**fields))
    return training.policy, *training.processors, Samples(training)


class Samples:
    """Samples of a training by global index, with images as floats; otherwise LeRobot's dataset."""

    def __init__(self, training: Training) -> None:
        self._dataset, self._samples = training.dataset, training.samples()

    def __getitem__(self, index: int) -> dict[str, Any]:
        found = self._samples[index]
        images = [name for name, value in found.items() if getattr(value, "dtype", None) == torch.uint8]
        return found | {name: found[name].float() / 255 for name in images}

    def __len__(self) -> int:
        return len(self._dataset)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._dataset, name)


def batch_of(samples: Any, indices: list[int]) -> dict[str, Any]:
    return torch.utils.data.default_collate([samples[index] for index in indices])


def histories(frames: Tensor, steps: Tensor, mask: Tensor) -> Histories:
    """Return histories of frames (B, F, P, D) at steps (B, F) with a mask (B, F), without shared frames."""
    places = torch.arange(mask.numel(), device=mask.device).reshape(mask.shape)
    return Histories(frames.flatten(0, 1), steps.flatten(), places.masked_fill(~mask, -1))


def trained_on(batch: Mapping[str, Tensor]) -> list[tuple[Tensor, list[int]]]:
    """Return the remembered frames (n, P, D) of each training sample, and their control steps."""
    places = [row[row >= 0] for row in batch[PLACES]]
    return [(batch[FRAMES][row], batch[STEPS][row].tolist()) for row in places]


def remembered(policy: Any, rows: Sequence[int]) -> list[tuple[Tensor, list[int]]]:
    """Return the remembered frames of rows of a policy's rollout, and their control steps."""
    found = []
    policy.write_kept()
    for row in rows:
        (kept,) = policy.rollout.envs[row].memory
        read = [kept[slot] for slot in sample_frames(len(kept) - 1, policy.model.memory.settings.frames)]
        found.append((torch.stack([frame.stored for frame in read]), [frame.step for frame in read]))
    return found
