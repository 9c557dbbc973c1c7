"""What a training batch is made of, and which of its actions count."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.scripts.lerobot_train import train

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.sampler import execution_starts
from lerobot_memobench.policies.memobench_mem.training import counted_actions, mean_losses
from tests.support.small_policy import CHUNK, batch_of, made_for_training, small_config

EXECUTION = [*range(40), *range(48, 94)]  # the second episode, from 40 on, has eight prompt frames


def test_execution_starts() -> None:
    phase = np.array([1, 1, 0, 0, 1, 0, 0])
    assert execution_starts(np.array([0, 2, 5, 7]), phase).tolist() == [0, 4, 7]


def test_lerobot_train_draws_every_execution_frame_once_and_no_prompt(
    dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []
    forward = MemobenchMemPolicy.forward

    def spied(self: MemobenchMemPolicy, batch: dict[str, torch.Tensor]) -> object:
        drawn.extend(batch["index"].tolist())
        assert batch["phase"].all()
        return forward(self, batch)

    monkeypatch.setattr(MemobenchMemPolicy, "forward", spied)
    train(
        TrainPipelineConfig(
            dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(dataset_root)),
            policy=small_config(memory_frames=2),
            output_dir=tmp_path / "run",
            steps=2,
            batch_size=len(EXECUTION) // 2,
            num_workers=0,
            save_checkpoint=False,
        )
    )
    assert sorted(drawn) == EXECUTION
    assert drawn != sorted(drawn)


def test_the_sampler_begins_where_the_configuration_says(dataset_root: Path) -> None:
    policy, _, _, dataset = made_for_training(dataset_root)
    ranges = [list(dataset.meta.episodes[f"dataset_{end}_index"]) for end in ("from", "to")]

    def drawn(drop: int, **options: bool) -> list[int]:
        return list(EpisodeAwareSampler(*ranges, drop_n_last_frames=drop, **options))

    asked = policy.config.drop_n_last_frames
    assert drawn(asked) == EXECUTION
    assert drawn(asked, shuffle=True) == drawn(asked, shuffle=True)
    # Other policies draw as ever; so does a configuration that is made for no dataset.
    assert drawn(0) == list(range(94))
    assert drawn(3) == [*range(37), *range(40, 60), *range(63, 91)]
    assert small_config().drop_n_last_frames == 0
    assert ranges[0] == [0, 40, 63]


def test_padded_actions_do_not_count(dataset_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame 38 is the last but one of its episode: of its chunk two actions are real."""
    policy, before, _, dataset = made_for_training(dataset_root)
    batch = before(batch_of(dataset, [38, 5]))
    losses = torch.ones(2, CHUNK, policy.config.max_action_dim)
    losses[0, 2:] = 1000.0
    losses[0, :2] = 5.0
    monkeypatch.setattr(policy.model, "forward", lambda *_: losses)
    _, logged = policy.forward(batch)
    assert logged["action_loss"] == pytest.approx((2 * 5.0 + CHUNK * 1.0) / (2 + CHUNK))
    assert logged["loss_per_dim"] == pytest.approx([logged["action_loss"]] * 7)
    per_sample, _ = policy.forward(batch, reduction="none")
    assert per_sample.mean().item() == pytest.approx(logged["action_loss"])


def test_mean_losses_without_padding_is_the_mean() -> None:
    losses = torch.rand(4, 5, 3)
    found = mean_losses(losses, counted_actions({}, losses))
    torch.testing.assert_close(found.mean, losses.mean())
    torch.testing.assert_close(found.per_sample, losses.mean(dim=(1, 2)))
    nothing = mean_losses(losses, torch.zeros(4, 5))
    assert nothing.mean == 0
    assert nothing.per_sample.tolist() == [0] * 4
