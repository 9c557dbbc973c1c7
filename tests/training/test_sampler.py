"""The frames of a training and their order, also after a resume."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler
from lerobot.datasets.sampler import compute_sampler_state

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.training.data import execution_statistics, open_datasets, open_training
from lerobot_memobench.training.loop import make_held_out_loader, make_sampler
from lerobot_memobench.training.sampler import frame_sampler, grouped_order, weighted_order
from tests.support.held_dataset import HELD, LENGTHS, PROMPTS, STRETCHES, make_held_dataset
from tests.support.small_policy import small_config

EPISODES, PHASE = np.array([0, 40, 63, 94]), np.ones(94, int)
PHASE[40:48] = 0
ACTS = ~HELD
ACTS[: PROMPTS[0]] = False


def sampler(**options: Any) -> Any:
    return frame_sampler(EPISODES, PHASE, options.pop("used", None), seed=5, **options)


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
    ours.go_on(step, batch_size, processes)
    state = compute_sampler_state(step, len(whole), batch_size, processes)
    assert (ours.epoch, ours.offset) == (state["epoch"], state["start_index"])
    epochs = [list(whole) for _ in range(4)]
    assert list(ours) == epochs[ours.epoch - 1][state["start_index"] :]
    assert list(ours) == epochs[state["epoch"] + 1]


def test_dataset_without_execution_is_refused() -> None:
    with pytest.raises(MemobenchError, match="execution frame"):
        frame_sampler(EPISODES, np.zeros(94, int), None)


@pytest.mark.parametrize(
    "options", [{}, {"together": 3}, {"together": 3, "tasks": (np.array([0, 1]), np.array([1.0, 2.0]))}]
)
def test_held_frames_are_not_drawn(options: dict[str, Any]) -> None:
    def made() -> Any:
        return frame_sampler(np.cumsum([0, *LENGTHS]), ACTS, None, seed=5, **options)

    whole, resumed = made(), made()
    drawn = list(whole)
    assert len(drawn) == len(whole) == ACTS.sum()
    assert ACTS[drawn].all()
    if "tasks" not in options:
        assert sorted(drawn) == np.flatnonzero(ACTS).tolist()
    resumed.go_on(2, 4, 1)
    assert list(resumed) == drawn[8:]


@pytest.mark.parametrize("moments", [1, 3, 6])
def test_grouped_order_draws_every_frame_once(moments: int) -> None:
    ends = np.cumsum([7, 30, 1, 12])
    order = grouped_order(ends, moments, torch.Generator().manual_seed(1))
    assert sorted(order.tolist()) == list(range(50))
    episodes = np.searchsorted(ends, order.numpy(), "right").tolist()
    runs = [episodes[0:1]]
    for episode in episodes[1:]:
        if episode == runs[-1][-1] and len(runs[-1]) < moments:
            runs[-1].append(episode)
        else:
            runs.append([episode])
    assert len(runs) <= 2 + -(-7 // moments) + -(-30 // moments) + -(-12 // moments)
    assert not torch.equal(order, grouped_order(ends, moments, torch.Generator().manual_seed(2)))


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


def test_held_out_samples_are_spread_over_the_episodes(objects: Path) -> None:
    config = TrainPipelineConfig(
        DatasetConfig("local/data", root=str(objects), eval_split=0.4),
        policy=small_config(size="tiny", perception="objects"),
        batch_size=4,
        max_eval_samples=5,
    )
    training = open_training(config, open_datasets(config))
    loader: Any = make_held_out_loader(config, training)
    frames = loader.dataset.indices
    episodes = [training.lookup.locate(frame)[0] for frame in frames]
    held_out = training.held_out
    assert held_out is not None
    assert len(frames) <= 5
    assert set(episodes) == set(held_out.episodes or [])
    first, last = training.lookup.episodes[episodes[-1]], training.lookup.episodes[episodes[-1] + 1]
    assert frames[-1] > (first + last) / 2


def test_null_draws_frames_uniformly(objects: Path) -> None:
    for given, drawn in (({}, False), (None, True)):
        config = TrainPipelineConfig(
            DatasetConfig("local/data", root=str(objects)),
            policy=small_config(size="tiny", perception="objects", task_weights=given),
        )
        training = open_training(config, open_datasets(config))
        assert (sorted(make_sampler(config, training)) == sorted(make_sampler(config, training).frames)) is drawn


@pytest.mark.parametrize("perception", ["objects", "pixels"])
def test_chunks_end_at_a_hold(perception: str, tmp_path: Path) -> None:
    """Also those of LeRobot's dataset; statistics are of the frames to learn from."""
    root = make_held_dataset(tmp_path / "held", pictures=perception == "pixels")
    config = TrainPipelineConfig(
        DatasetConfig("local/data", root=str(root)),
        policy=small_config(size="tiny", perception=perception, chunk_size=4, n_action_steps=4),
    )
    training = open_training(config, open_datasets(config))
    lookup, samples = training.lookup, training.samples()
    np.testing.assert_array_equal(lookup.acts, ACTS)
    assert sorted(make_sampler(config, training).frames) == np.flatnonzero(ACTS).tolist()
    for start, end in STRETCHES:
        for frame in (start, end - 2, end - 1):
            there = min(4, end - frame)
            assert samples[frame]["action_is_pad"].tolist() == [False] * there + [True] * (4 - there)
            whole = np.asarray(training.dataset.hf_dataset[frame : frame + there]["action"])
            np.testing.assert_array_equal(samples[frame]["action"][:there], whole)
    if lookup.columns:
        actions = lookup.columns["action"].numpy()[ACTS]
        mean = execution_statistics(lookup)["action"]["mean"]
        np.testing.assert_allclose(mean, actions.mean(axis=0), atol=1e-6)
