"""Settings that a training refuses before it starts, and checkpoints of earlier versions."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lerobot.configs.default import DatasetConfig, EvalConfig, JobConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.run.command_line import parse_words, read_words
from lerobot_memobench.sim.scene_hash import LIBERO
from lerobot_memobench.training.command import READ, check_settings, complete_training
from lerobot_memobench.training.data import check_dataset_version, open_datasets
from lerobot_memobench.training.loop import begin
from tests.support.object_dataset import make_object_dataset


def config(**settings: Any) -> TrainPipelineConfig:
    policy = MemobenchMemConfig(device="cpu", push_to_hub=False)
    return TrainPipelineConfig(DatasetConfig("memobench/synthetic"), policy=policy, **settings)


@pytest.mark.parametrize("word", ["steps=0", "batch_size=-1", "num_workers=-1", "eval.n_episodes=0"])
def test_too_small_numbers_are_refused(word: str, synthetic: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "policy=act", f"dataset={synthetic}", word]) == 2
    assert f"found {word}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"dataset": DatasetConfig("a/b", streaming=True)}, "dataset.streaming"),
        ({"sample_weighting": SimpleNamespace()}, "sample_weighting"),
        ({"job": JobConfig(target="a10g-small")}, "job.target=a10g-small has no effect"),
        ({"reward_model": SimpleNamespace()}, "reward_model"),
        ({"field_of_tomorrow": 3}, "field_of_tomorrow=3 has no effect"),
        ({"eval": EvalConfig(recording=True)}, "eval.recording"),
        ({"parallelism": SimpleNamespace(is_sharded=True)}, "parallelism"),
        ({"ema": SimpleNamespace(enable=True)}, "ema"),
        ({"checkpoint_format": "dcp"}, "checkpoint_format"),
    ],
    ids=lambda part: next(iter(part)) if isinstance(part, dict) else part,
)
def test_unsupported_settings_are_refused(changed: dict[str, Any], named: str) -> None:
    check_settings(config())
    asked = config()
    for name, value in changed.items():
        setattr(asked, name, value)
    with pytest.raises(MemobenchError, match=named):
        check_settings(asked)


@pytest.mark.parametrize(
    ("word", "named"),
    [
        ("eval_steps=2", "dataset.eval_split"),
        ("rename_map={a: b}", "rename_map"),
        ("save_checkpoint_to_hub=true", "policy.repo_id"),
        ("use_policy_training_preset=false", "Optimizer"),
    ],
)
@pytest.mark.parametrize("policy", ["act", "memobench_mem"])
def test_lerobots_own_checks_are_made_before_a_training(policy: str, word: str, named: str) -> None:
    words = [f"policy={policy}", "device=cpu", word]
    with pytest.raises(MemobenchError, match=named):
        complete_training(read_words("train", parse_words(words)))


def test_demonstrations_of_former_scenes_are_refused(tmp_path: Path) -> None:
    for world in (LIBERO, None):  # version 0.2 wrote none
        root = make_object_dataset(tmp_path / str(world), records=True, world=world)
        meta = LeRobotDatasetMetadata("memobench/objects", root=root)
        if world is None:
            with pytest.raises(MemobenchError, match=r"episode 0 of .* is of the scenes that version 0\.2"):
                check_dataset_version(meta)
        else:
            check_dataset_version(meta)


def test_each_field_of_lerobots_configuration_is_read_or_refused() -> None:
    """A field that a later LeRobot adds is refused until it is listed here or read."""
    refused = {"job", "reward_model", "sample_weighting"}
    main = {"accelerator", "checkpoint_format", "ema", "parallelism"}
    assert READ | refused <= {field.name for field in fields(TrainPipelineConfig)} <= READ | refused | main


def test_mixed_precision_and_accumulation_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = config()
    asked.policy.use_amp = True  # type: ignore[union-attr]
    with pytest.raises(MemobenchError, match="use_amp"):
        check_settings(asked)
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
    asked = config()
    asked.dataset = replace(asked.dataset, root=str(synthetic), episodes=episodes)
    with pytest.raises(MemobenchError, match=f"episodes={named}"):
        open_datasets(asked)


def test_existing_output_folder_is_refused(objects: Path, tmp_path: Path, train: Any) -> None:
    with pytest.raises(MemobenchError, match="resume=true"):
        train("policy=memobench_mem", f"dataset={objects}", f"output_dir={tmp_path}")
