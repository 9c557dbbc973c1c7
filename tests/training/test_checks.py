"""Settings that a training refuses before it starts, and checkpoints of earlier versions."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import SHIPPED, checkpoint_type
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.update_checkpoint import update_checkpoint
from lerobot_memobench.training.configuration import check_settings
from lerobot_memobench.training.data import open_datasets
from lerobot_memobench.training.loop import quick_products, quicker_in_bfloat16


def config(**settings: Any) -> TrainPipelineConfig:
    policy = MemobenchMemConfig(device="cpu", push_to_hub=False)
    return TrainPipelineConfig(DatasetConfig("memobench/synthetic"), policy=policy, **settings)


@pytest.mark.parametrize("word", ["steps=0", "batch_size=-1", "num_workers=-1", "eval.n_episodes=0"])
def test_too_small_numbers_are_refused(word: str, synthetic: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "policy=act", f"dataset={synthetic}", word]) == 2
    assert f"found {word}" in capsys.readouterr().err


def test_too_small_numbers_of_a_recipe_are_refused(
    synthetic: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump({"policy": {"type": "act"}, "eval": {"n_episodes": 0}}))
    words = [f"config_path={tmp_path / 'recipe.yaml'}", f"dataset={synthetic}", f"output_dir={tmp_path / 'run'}"]
    assert main(["train", *words]) == 2
    assert "found eval.n_episodes=0" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["prompt_frames=some", "obs_type=environment"])
def test_unknown_choices_are_refused(word: str, synthetic: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "policy=act", f"dataset={synthetic}", word]) == 2
    assert word.partition("=")[0] in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"dataset": DatasetConfig("a/b", streaming=True)}, "dataset.streaming"),
        ({"sample_weighting": SimpleNamespace()}, "sample_weighting"),
        ({"job": SimpleNamespace(is_remote=True)}, "job.target"),
        ({"eval_steps": 2}, "dataset.eval_split"),
        ({"rename_map": {"a": "b"}}, "rename_map"),
        ({"save_checkpoint_to_hub": True}, "policy.repo_id"),
        ({"use_policy_training_preset": False}, "optimizer.type"),
        ({"parallelism": SimpleNamespace(is_sharded=True)}, "parallelism.dp_shard"),
        ({"ema": SimpleNamespace(enable=True)}, "ema.enable"),
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


def test_update_of_an_earlier_checkpoint(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(SHIPPED / "memobench_small", tmp_path / "old"))
    today = json.loads((folder / "config.json").read_text())
    removed = {"feature_cache_dir": "x", "shuffle_seed": 7, "align_weight": 0.1, "min_lr_ratio": 0.5}
    (folder / "config.json").write_text(json.dumps(today | removed))
    (folder / "train_config.json").write_text(json.dumps({"steps": 3, "policy": today | removed}))
    with pytest.raises(MemobenchError, match="update_checkpoint"):
        checkpoint_type(str(folder))
    notes = update_checkpoint(folder)
    assert len(notes) == 1
    assert "min_lr_ratio" in notes[0]
    assert json.loads((folder / "config.json").read_text()) == today
    assert json.loads((folder / "train_config.json").read_text()) == {"steps": 3, "policy": today}
    assert checkpoint_type(str(folder)) == "memobench_mem"


@pytest.mark.parametrize(
    ("instructions", "quicker"),
    [(("amx_bf16",), True), (("avx512_bf16",), True), (("avx512_bf16", "avx512_fp16"), False), ((), False)],
)
def test_products_are_rounded_on_cpus_with_bfloat16_instructions(
    instructions: tuple[str, ...], quicker: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr("torch.cpu.get_capabilities", lambda: dict.fromkeys(instructions, True), raising=False)
    products: Any = torch.backends.mkldnn.matmul
    before = products.fp32_precision
    assert quicker_in_bfloat16() is quicker
    with quick_products():
        assert (products.fp32_precision == "bf16") is quicker
    assert products.fp32_precision == before
