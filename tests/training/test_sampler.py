"""The frames of a training and their order, also after a resume."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import EpisodeAwareSampler
from lerobot.datasets.sampler import compute_sampler_state

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.training.sampler import frame_sampler, grouped_order, weighted_order

EPISODES, PHASE = np.array([0, 40, 63, 94]), np.ones(94, int)
PHASE[40:48] = 0


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
