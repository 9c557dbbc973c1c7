"""Settings and datasets that a training refuses before it starts."""

from __future__ import annotations

import re
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_memobench.commands.command_line import parse_words, read_words
from lerobot_memobench.datasets.episodes import goals_of
from lerobot_memobench.envs.settings import STRICT_GOALS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.tasks.catalogue import task_names
from lerobot_memobench.tasks.task import PUBLISHED, STRICT
from lerobot_memobench.training.command import READ, check_settings, complete_training
from lerobot_memobench.training.data import open_metadata
from lerobot_memobench.training.loop import begin
from tests.support.synthetic_dataset import make_object_dataset

LEROBOTS = [  # checks of LeRobot's configuration
    ("eval_steps=2", "dataset.eval_split"),
    ("rename_map={a: b}", "rename_map"),
    ("save_checkpoint_to_hub=true", "policy.repo_id"),
    ("use_policy_training_preset=false", "Optimizer"),
]


def config() -> TrainPipelineConfig:
    policy = MemobenchMemConfig(device="cpu", push_to_hub=False)
    return TrainPipelineConfig(DatasetConfig("memobench/synthetic"), policy=policy)


@pytest.mark.parametrize(
    ("policy", "word", "named"),
    [
        *(("act", word, f"found {word}") for word in ("steps=0", "batch_size=-1", "num_workers=-1")),
        *(("act", *case) for case in LEROBOTS),
        *(("memobench_mem", *case) for case in LEROBOTS),
        ("act", "eval.n_episodes=0", "found eval.n_episodes=0"),
        ("memobench_mem", "dataset.streaming=true", "dataset.streaming"),
        ("memobench_mem", "job.target=a10g-small", "job.target=a10g-small has no effect"),
        ("memobench_mem", "eval.recording=true", "eval.recording"),
        ("memobench_mem", "policy.use_amp=true", "use_amp"),
        ("memobench_mem", "output_dir=.", "resume=true"),
    ],
)
def test_settings_are_refused(policy: str, word: str, named: str) -> None:
    asked = read_words("train", parse_words([f"policy={policy}", "device=cpu", word]))
    with pytest.raises(MemobenchError, match=re.escape(named)):
        complete_training(asked)


def test_each_field_of_lerobots_configuration_is_read_or_refused() -> None:
    """A field that a later LeRobot adds is refused until it is listed here or read."""
    refused = {"job", "reward_model", "sample_weighting"}
    main = {"accelerator", "checkpoint_format", "ema", "parallelism"}
    assert READ | refused <= {field.name for field in fields(TrainPipelineConfig)} <= READ | refused | main
    asked: Any = config()
    check_settings(asked)
    asked.field_of_tomorrow = 3
    with pytest.raises(MemobenchError, match="field_of_tomorrow=3 has no effect"):
        check_settings(asked)


@pytest.mark.parametrize("goals", [None, 3])
def test_demonstrations_of_other_goals_are_refused(tmp_path: Path, goals: int | None) -> None:
    assert (goals_of(task_names(suite=STRICT)[0]), goals_of(task_names(suite=PUBLISHED)[0])) == (STRICT_GOALS, 0)
    root = make_object_dataset(tmp_path / "data", records=True, goals=goals)
    error = pytest.raises(MemobenchError, match=r"episode 0: the goal of .* has version 3, expected 0")
    with nullcontext() if goals is None else error:
        open_metadata(DatasetConfig("memobench/objects", root=str(root)))


def test_accumulation_of_gradients_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ACCELERATE_GRADIENT_ACCUMULATION_STEPS", "4")
    with pytest.raises(MemobenchError, match="gradient_accumulation_steps=4"):
        begin(config())


def test_image_transforms_are_refused_if_images_are_encoded_once() -> None:
    asked = config()
    asked.dataset.image_transforms.enable = True
    check_settings(asked)
    asked.policy = MemobenchMemConfig(device="cpu", push_to_hub=False, size="small")
    with pytest.raises(MemobenchError, match="image_transforms"):
        check_settings(asked)


@pytest.mark.parametrize(("episodes", "named"), [([7], r"\[7\]"), ([0, 3], r"\[3\]"), ([], r"\[\]")])
def test_missing_episodes_are_refused(synthetic: Path, episodes: list[int], named: str) -> None:
    with pytest.raises(MemobenchError, match=f"episodes={named}"):
        open_metadata(DatasetConfig("memobench/synthetic", root=str(synthetic), episodes=episodes))
