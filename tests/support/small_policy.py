"""A small memory policy with its processors and dataset, as lerobot-train makes them; shared by tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import FLOW_MATCHING, MemobenchMemConfig

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


def opened(root: Path, config: MemobenchMemConfig) -> LeRobotDataset:
    """Return a dataset as lerobot-train opens it for a policy."""
    meta = LeRobotDatasetMetadata("memobench/synthetic", root=root)
    return LeRobotDataset("memobench/synthetic", root=root, delta_timestamps=resolve_delta_timestamps(config, meta))


def made_for_training(root: Path, **fields: Any):  # type: ignore[no-untyped-def]
    """Policy, preprocessor, postprocessor and dataset, as lerobot-train makes them."""
    config = small_config(**fields)
    dataset = opened(root, config)
    torch.manual_seed(0)
    policy = make_policy(config, ds_meta=dataset.meta)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    return policy, before, after, dataset


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


def batch_of(dataset: LeRobotDataset, indices: list[int]) -> dict[str, Any]:
    return torch.utils.data.default_collate([dataset[index] for index in indices])
