"""Random numbers of a training: by seed, process and update; an augmentation by seed and draw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from lerobot.datasets import LeRobotDataset
from lerobot.transforms import ImageTransforms, ImageTransformsConfig

from lerobot_memobench.datasets.frames import FrameLookup, read_frame_table
from lerobot_memobench.policies.memobench_mem import modeling_memobench_mem as modeling
from lerobot_memobench.training.data import DecodedSamples
from lerobot_memobench.training.sampler import frame_sampler

PICTURE = "observation.images.image"


def test_processes_draw_different_noise_of_the_same_policy(
    objects: Path, tmp_path: Path, train: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[float] = []
    draw = modeling.noise_and_time

    def noted(objective: str, actions: torch.Tensor) -> Any:
        noise, time = draw(objective, actions)
        drawn.append(noise.sum().item())
        assert torch.get_float32_matmul_precision() != "medium", "dtype sets the precision, not the processor"
        return noise, time

    monkeypatch.setattr(modeling, "noise_and_time", noted)
    words = ("policy=memobench_mem", "perception=objects", "size=tiny", "batch_size=8", "policy.chunk_size=4")
    for rank in (0, 1):
        monkeypatch.setattr(Accelerator, "process_index", property(lambda _, rank=rank: rank))
        train(*words, f"dataset={objects}", f"output_dir={tmp_path / str(rank)}", "steps=1", "save_checkpoint=false")
    assert drawn[0] != drawn[1]


def test_augmentation_follows_seed_and_draw(synthetic: Path) -> None:
    transforms = ImageTransforms(ImageTransformsConfig(enable=True))
    times = {"action": [0.0]}
    dataset = LeRobotDataset("memobench/synthetic", root=synthetic, image_transforms=transforms, delta_timestamps=times)
    lookup = FrameLookup(synthetic, read_frame_table(synthetic))

    def picture(seed: int, number: int) -> torch.Tensor:
        found: torch.Tensor = DecodedSamples(dataset, lookup, [0], seed)[5, number][PICTURE]
        return found

    state = torch.get_rng_state()
    first = picture(3, 0)
    assert torch.equal(torch.get_rng_state(), state)
    torch.rand(1)
    assert torch.equal(picture(3, 0), first)
    assert not torch.equal(picture(3, 1), first)
    assert not torch.equal(picture(4, 0), first)


def test_draws_are_numbered_across_epochs_and_resumes() -> None:
    episodes, phase = np.array([0, 4, 9]), np.ones(9, int)
    whole = frame_sampler(episodes, phase, None, seed=5, numbered=True)
    draws = [draw for _ in range(3) for draw in whole]
    assert [number for _, number in draws] == list(range(27))
    resumed = frame_sampler(episodes, phase, None, seed=5, numbered=True)
    resumed.go_on(step=7, batch_size=2, processes=1)
    assert list(resumed) == draws[13:18]
