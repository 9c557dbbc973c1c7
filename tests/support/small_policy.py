"""A small memory policy with its processors and samples, as `lerobot train` makes them; shared by tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import FLOW_MATCHING, MemobenchMemConfig
from lerobot_memobench.training.data import Training, open_datasets, open_training
from lerobot_memobench.training.loop import train

CHUNK = 6


def small_config(**fields: Any) -> MemobenchMemConfig:
    """Return a configuration of few actions, and where they are read, of few denoising steps and remembered frames."""
    if "none" in (fields.get("memory"), fields.get("memory_fusion")):
        fields.pop("memory_stride", None)
    read = MemobenchMemConfig(device="cpu", **fields)
    usual: dict[str, Any] = {"chunk_size": CHUNK, "n_action_steps": CHUNK}
    if read.objective == FLOW_MATCHING:
        usual["num_inference_steps"] = 2
    if read.memory in ("frames", "subgoal"):
        usual["memory_frames"] = 8
    return MemobenchMemConfig(device="cpu", push_to_hub=False, **usual | fields)


def train_config(root: Path, config: MemobenchMemConfig, **settings: Any) -> TrainPipelineConfig:
    """Return LeRobot's configuration of a training on a dataset."""
    return TrainPipelineConfig(DatasetConfig("memobench/synthetic", root=str(root)), policy=config, **settings)


def train_with(config: TrainPipelineConfig) -> None:
    """Train as `lerobot train` does, by a configuration of LeRobot's."""
    policy: Any = config.policy
    config.optimizer, config.scheduler = policy.get_optimizer_preset(), policy.get_scheduler_preset()
    train(config)


def open_small_training(root: Path, config: MemobenchMemConfig) -> Training:
    """Return the training of a policy on a dataset; weights are drawn from seed 0."""
    whole = train_config(root, config)
    datasets = open_datasets(whole)
    torch.manual_seed(0)
    return open_training(whole, datasets)


def made_for_training(root: Path, **fields: Any):  # type: ignore[no-untyped-def]
    """Policy, preprocessor, postprocessor and samples, as `lerobot train` makes them."""
    training = open_small_training(root, small_config(**fields))
    return training.policy, *training.processors, Samples(training)


class Samples:
    """The samples of a training by their global indices, with pictures as floats; else LeRobot's dataset."""

    def __init__(self, training: Training) -> None:
        self._dataset, self._samples = training.dataset, training.samples()

    def __getitem__(self, index: int) -> dict[str, Any]:
        found = self._samples[index]
        pictures = [name for name, value in found.items() if getattr(value, "dtype", None) == torch.uint8]
        return found | {name: found[name].float() / 255 for name in pictures}

    def __len__(self) -> int:
        return len(self._dataset)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._dataset, name)


def losses_in_training(policy: Any, batch: dict[str, Any], updates: int = 40) -> list[float]:
    """Train a policy on one batch; return the action loss before each update."""
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=3e-3)
    losses = []
    for _ in range(updates):
        loss, logged = policy.train().forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(logged["action_loss"])
    return losses


def batch_of(samples: Any, indices: list[int]) -> dict[str, Any]:
    return torch.utils.data.default_collate([samples[index] for index in indices])
