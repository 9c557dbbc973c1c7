"""Trained checkpoints of alignments and controls are evaluated in the simulator by the command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from tests.support.small_policy import train_with

TASK = "turn_on_the_stove_and_turn_it_off"
HORIZON = 12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fields", "settings"),
    [
        ({"align": "none"}, []),
        ({"align": "contrastive"}, []),
        ({"align": "framewise"}, []),
        ({"memory_fusion": "context"}, []),
        ({"memory": "none", "oracle_memory": True}, ["env.oracle_memory=true"]),
    ],
    ids=["none", "contrastive", "framewise", "context", "oracle"],
)
def test_trained_checkpoints_are_evaluated(
    fields: dict[str, Any], settings: list[str], dataset_root: Path, tmp_path: Path
) -> None:
    train_with(
        TrainPipelineConfig(
            dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(dataset_root)),
            policy=MemobenchMemConfig(
                device="cpu", push_to_hub=False, chunk_size=6, n_action_steps=6, num_inference_steps=2, **fields
            ),
            output_dir=tmp_path / "run",
            steps=2,
            batch_size=4,
            num_workers=0,
            save_freq=2,
        )
    )
    out = tmp_path / "eval"
    words = ["eval", "env=memobench", f"policy={tmp_path / 'run'}", f"tasks={TASK}", "episodes=2", "batch_size=2"]
    assert main([*words, f"horizon={HORIZON}", "replan=6", f"output_dir={out}", "device=cpu", *settings]) == 0
    episodes = read_episodes(out)
    assert [(episode["task"], episode["steps"], episode["replan_steps"]) for episode in episodes] == [
        (TASK, HORIZON, 6)
    ] * 2
    assert sorted(episode["episode"] for episode in episodes) == [0, 1]


@pytest.mark.slow
def test_oracle_checkpoint_needs_oracle_memory(dataset_root: Path, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies import make_policy, make_pre_post_processors

    config = MemobenchMemConfig(device="cpu", push_to_hub=False, memory="none", oracle_memory=True)
    meta = LeRobotDataset("memobench/synthetic", root=dataset_root).meta
    policy = make_policy(config, ds_meta=meta)
    folder = tmp_path / "pretrained_model"
    for part in (policy, *make_pre_post_processors(config, dataset_stats=meta.stats)):
        part.save_pretrained(folder)
    words = ["eval", "env=memobench", f"policy={folder}", f"tasks={TASK}", "episodes=1", "horizon=3", "device=cpu"]
    assert main([*words, f"output_dir={tmp_path / 'eval'}"]) == 2
