"""Frames of a training, their order and their random numbers, also after a resume."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
from lerobot.datasets.sampler import compute_sampler_state
from lerobot.transforms import ImageTransforms, ImageTransformsConfig

from lerobot_memobench.datasets.frames import FrameLookup, read_frame_table
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import modeling_memobench_mem as modeling
from lerobot_memobench.training.data import DecodedSamples, Training, execution_statistics, open_datasets, open_training
from lerobot_memobench.training.loop import make_held_out_loader, make_sampler
from lerobot_memobench.training.sampler import FrameSampler, weighted_order
from tests.support.held_dataset import HELD, LENGTHS, PROMPTS, STRETCHES, make_held_dataset
from tests.support.small_policy import small_config

EPISODES, PHASE = np.array([0, 40, 63, 94]), np.ones(94, int)
PHASE[40:48] = 0
ACTS = ~HELD
ACTS[: PROMPTS[0]] = False


def sampler(**options: Any) -> Any:
    return FrameSampler(EPISODES, PHASE, options.pop("used", None), seed=5, **options)


@pytest.mark.parametrize("used", [None, [2, 1]])
def test_single_frames_have_lerobots_order(used: list[int] | None) -> None:
    theirs = EpisodeAwareSampler([0, 48, 63], [40, 63, 94], episode_indices_to_use=used, shuffle=True, seed=5)
    ours = sampler(used=used)
    assert len(ours) == len(theirs)
    for _ in range(2):  # epochs
        assert list(ours) == list(theirs)


@pytest.mark.parametrize(("step", "batch_size", "processes"), [(3, 8, 1), (11, 8, 1), (25, 8, 1), (9, 4, 3)])
def test_resumed_training_draws_the_rest_of_the_epoch(step: int, batch_size: int, processes: int) -> None:
    ours, whole = sampler(), sampler()
    ours.resume_from(step, batch_size, processes)
    state = compute_sampler_state(step, len(whole), batch_size, processes)
    assert (ours.epoch, ours.offset) == (state["epoch"], state["start_index"])
    epochs = [list(whole) for _ in range(4)]
    assert list(ours) == epochs[ours.epoch - 1][state["start_index"] :]
    assert list(ours) == epochs[state["epoch"] + 1]


def test_draws_are_numbered_across_epochs_and_resumes() -> None:
    whole, resumed = sampler(numbered=True), sampler(numbered=True)
    draws = [draw for _ in range(3) for draw in whole]
    assert [number for _, number in draws] == list(range(3 * len(whole)))
    resumed.resume_from(step=12, batch_size=8, processes=1)
    assert list(resumed) == draws[len(whole) + 8 : 2 * len(whole)], "the eleventh batch is the last one of an epoch"


def test_dataset_without_execution_is_refused() -> None:
    with pytest.raises(MemobenchError, match="execution frame"):
        FrameSampler(EPISODES, np.zeros(94, int), None)


@pytest.mark.parametrize(
    "options", [{}, {"together": 3}, {"together": 3, "tasks": (np.array([0, 1]), np.array([1.0, 2.0]))}]
)
def test_held_frames_are_not_drawn(options: dict[str, Any]) -> None:
    def made() -> Any:
        return FrameSampler(np.cumsum([0, *LENGTHS]), ACTS, None, seed=5, **options)

    whole, resumed = made(), made()
    drawn = list(whole)
    assert len(drawn) == len(whole) == ACTS.sum()
    assert ACTS[drawn].all()
    if "tasks" not in options:
        assert sorted(drawn) == np.flatnonzero(ACTS).tolist()
    resumed.resume_from(2, 4, 1)
    assert list(resumed) == drawn[8:]


@pytest.mark.parametrize("weights", [(1, 1, 1), (1, 3, 2)])
def test_tasks_are_drawn_by_weight_and_not_by_length(weights: tuple[int, ...]) -> None:
    ends, tasks = np.cumsum([600, 30, 1, 1200, 20]), np.array([2, 0, 1, 2, 0])
    chance = torch.Generator().manual_seed(1)
    order = weighted_order(ends, tasks, np.array(weights, float), 6, chance).numpy()
    assert len(order) == ends[-1]
    episodes = np.searchsorted(ends, order, "right")
    groups = episodes[: len(order) // 6 * 6].reshape(-1, 6)
    assert (groups == groups[:, :1]).all(), "six frames of an episode follow one another"
    shares = np.bincount(episodes, minlength=5) / len(order)
    first, second, third = np.array(weights) / sum(weights)
    assert shares == pytest.approx([third / 2, first / 2, second, third / 2, first / 2], abs=0.06)
    assert len(set(order[episodes == 0].tolist())) > 150, "frames of an episode are drawn at random"


def opened(root: Path, eval_split: float = 0.0, **policy: Any) -> tuple[TrainPipelineConfig, Training]:
    config = TrainPipelineConfig(
        DatasetConfig("local/data", root=str(root), eval_split=eval_split),
        policy=small_config(**{"size": "tiny", "perception": "objects"} | policy),
        batch_size=4,
        max_eval_samples=5,
    )
    return config, open_training(config, open_datasets(config))


def test_held_out_samples_are_spread_over_the_episodes(objects: Path) -> None:
    config, training = opened(objects, eval_split=0.4)
    loader: Any = make_held_out_loader(config, training)
    frames = loader.dataset.indices
    episodes = [training.lookup.locate(frame)[0] for frame in frames]
    held_out = training.held_out
    assert len(frames) <= 5
    assert set(episodes) == set(held_out.episodes or [])
    first, last = training.lookup.episodes[episodes[-1]], training.lookup.episodes[episodes[-1] + 1]
    assert frames[-1] > (first + last) / 2


def test_null_draws_frames_uniformly(objects: Path) -> None:
    for given, drawn in (({}, False), (None, True)):
        sampler = make_sampler(*opened(objects, task_weights=given))
        assert (sorted(sampler) == sorted(sampler.frames)) is drawn


@pytest.mark.parametrize("perception", ["objects", "pixels"])
def test_chunks_end_at_a_hold(perception: str, tmp_path: Path) -> None:
    """Also those of LeRobot's dataset; statistics are of the frames to learn from."""
    root = make_held_dataset(tmp_path / "held", images=perception == "pixels")
    config, training = opened(root, perception=perception, chunk_size=4, n_action_steps=4)
    lookup, samples = training.lookup, training.samples()
    np.testing.assert_array_equal(lookup.acts, ACTS)
    assert sorted(make_sampler(config, training).frames) == np.flatnonzero(ACTS).tolist()
    for start, end in STRETCHES:
        for frame in (start, end - 2, end - 1):
            there = min(4, end - frame)
            sample: dict[str, Any] = samples[frame]
            assert sample["action_is_pad"].tolist() == [False] * there + [True] * (4 - there)
            whole = np.asarray(training.dataset.hf_dataset[frame : frame + there]["action"])
            np.testing.assert_array_equal(sample["action"][:there], whole)
            for name in ("observation.state", "episode_index", "task_index", "task"):
                np.testing.assert_array_equal(sample[name], training.dataset[frame][name], name)
    if lookup.columns:
        actions = lookup.columns["action"].numpy()[ACTS]
        mean = execution_statistics(lookup)["action"]["mean"]
        np.testing.assert_allclose(mean, actions.mean(axis=0), atol=1e-6)


def test_processes_draw_different_noise_of_the_same_policy(
    objects: Path, tmp_path: Path, train: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[float] = []
    draw, forward = modeling.noise_and_time, modeling.MemobenchMemPolicy.forward
    weights: list[float] = []

    def noted(objective: str, actions: torch.Tensor) -> Any:
        noise, time = draw(objective, actions)
        drawn.append(noise.sum().item())
        assert torch.get_float32_matmul_precision() != "medium", "dtype sets the precision, not the processor"
        return noise, time

    def weighed(policy: Any, *arguments: Any, **named: Any) -> Any:
        weights.append(sum(parameter.sum().item() for parameter in policy.parameters()))
        return forward(policy, *arguments, **named)

    monkeypatch.setattr(modeling, "noise_and_time", noted)
    monkeypatch.setattr(modeling.MemobenchMemPolicy, "forward", weighed)
    words = ("policy=memobench_mem", "perception=objects", "size=tiny", "batch_size=8", "policy.chunk_size=4")
    for rank in (0, 1):
        monkeypatch.setattr(Accelerator, "process_index", property(lambda _, rank=rank: rank))
        train(*words, f"dataset={objects}", f"output_dir={tmp_path / str(rank)}", "steps=1", "save_checkpoint=false")
    assert drawn[0] != drawn[1]
    assert weights[0] == weights[1]


def test_augmentation_follows_seed_and_draw(synthetic: Path) -> None:
    transforms = ImageTransforms(ImageTransformsConfig(enable=True))
    times = {"action": [0.0]}
    dataset = LeRobotDataset("memobench/synthetic", root=synthetic, image_transforms=transforms, delta_timestamps=times)
    lookup = FrameLookup(synthetic, read_frame_table(synthetic))

    def image(seed: int, number: int) -> torch.Tensor:
        found: torch.Tensor = DecodedSamples(dataset, lookup, [0], seed)[5, number]["observation.images.image"]
        return found

    state = torch.get_rng_state()
    first = image(3, 0)
    assert torch.equal(torch.get_rng_state(), state)
    torch.rand(1)
    assert torch.equal(image(3, 0), first)
    assert not torch.equal(image(3, 1), first)
    assert not torch.equal(image(4, 0), first)
