"""The shipped recipes: the paper's values, one difference each, and every one of them trains."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from lerobot.configs.train import TrainPipelineConfig
from safetensors import safe_open

import lerobot_policy_memobench  # noqa: F401  (registers the policy and the environment)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.recipes import recipe_file, recipes, resolve_recipe
from lerobot_memobench.run.words import split_words

CONTRASTIVE = {"policy.align": "contrastive", "policy.align_weight": 0.1}
DIFFERENCES: dict[str, dict[str, Any]] = {
    "train_paper": {},
    "train_semantic": {"policy.align": "semantic", "policy.align_weight": 0.1},
    "train_contrastive": CONTRASTIVE,
    "train_framewise": {"policy.align": "framewise", "policy.align_weight": 0.05},
    "train_pi05": {"policy.integration": "none"},
    "train_oracle_memory": {"policy.integration": "none", "policy.oracle_memory": True},
    "train_subgoal_coarse": CONTRASTIVE | {"policy.subgoal_level": "coarse"},
    "train_subgoal_fine": CONTRASTIVE | {"policy.subgoal_level": "fine"},
    "train_shuffled_subgoals": CONTRASTIVE | {"policy.subgoal_level": "coarse", "policy.shuffle_subgoals": True},
    "train_referent_random": {"env.type": "memobench", "env.referent": "random"},
}


def _flat(mapping: dict[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in mapping.items():
        found |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {before + key: value}
    return found


def _parse(name: str, *overrides: str) -> TrainPipelineConfig:
    """As lerobot-train parses a file and its flags; on a CPU, whatever this machine has."""
    return TrainPipelineConfig.from_pretrained(recipe_file(name), cli_args=["--policy.device=cpu", *overrides])


def test_recipes_differ_in_what_they_are_named_for() -> None:
    assert set(recipes()) == set(DIFFERENCES)
    plain = _flat(yaml.safe_load(recipe_file("train_paper").read_text()))
    for name, difference in DIFFERENCES.items():
        found = _flat(yaml.safe_load(recipe_file(name).read_text()))
        assert found == plain | difference, name
        assert f"config={name} " in recipe_file(name).read_text()


@pytest.mark.parametrize("name", DIFFERENCES)
def test_values_are_the_papers(name: str) -> None:
    config = _parse(name, "--output_dir=/tmp/never-made")
    config.validate()  # where LeRobot takes the policy's presets
    policy: Any = config.policy
    optimizer: Any = config.optimizer
    assert (optimizer.lr, optimizer.betas, optimizer.weight_decay, optimizer.grad_clip_norm) == (
        5e-5,
        (0.9, 0.95),
        0.0,
        1.0,
    )
    assert type(optimizer).__name__ == "AdamWConfig"
    schedule: Any = config.scheduler
    assert (schedule.type, schedule.warmup_fraction) == ("memobench_constant_with_warmup", 0.05)
    assert (config.batch_size, config.steps, config.save_freq) == (64, 80_000, 10_000)
    assert (policy.ema_decay, policy.dtype, policy.gradient_checkpointing) == (0.999, "bfloat16", True)
    assert (policy.size, policy.freeze_vision_encoder, policy.image_resolution) == ("pi05", True, (224, 224))
    assert (policy.memory_frames, policy.tokens_per_frame, policy.chunk_size) == (32, 16, 50)
    for key, value in DIFFERENCES[name].items():
        section, field = key.split(".")
        assert getattr(getattr(config, section), field) == value, key


def _tiny(name: str, root: Path, out: Path) -> list[str]:
    """The command line that trains a recipe for two steps on a CPU."""
    return [
        "train",
        f"config={name}",
        f"dataset={root}",
        f"output_dir={out}",
        "size=tiny",
        "device=cpu",
        "policy.base_weights=null",
        "policy.dtype=float32",
        "policy.chunk_size=8",
        "policy.memory_frames=8",
        "steps=2",
        "batch_size=2",
        "num_workers=0",
        "log_freq=1",
    ]


def _train(name: str, root: Path, out: Path) -> Path:
    from lerobot_memobench.cli.lerobot import main

    assert main(_tiny(name, root, out)) == 0
    return out / "checkpoints" / "000002" / "pretrained_model"


def test_one_command_trains_a_recipe(dataset_root: Path, tmp_path: Path) -> None:
    checkpoint = _train("train_framewise", dataset_root, tmp_path / "run")
    with safe_open(checkpoint / "training_weights.safetensors", framework="pt") as file:
        assert file.metadata()["updates"] == "2"  # the average moved with every step, and is saved
    saved = yaml.safe_load((checkpoint / "config.json").read_text())
    assert (saved["align"], saved["align_weight"], saved["gradient_checkpointing"]) == ("framewise", 0.05, True)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in DIFFERENCES if name != "train_framewise"])
def test_every_recipe_trains(name: str, dataset_root: Path, tmp_path: Path) -> None:
    checkpoint = _train(name, dataset_root, tmp_path / "run")
    assert (checkpoint / "model.safetensors").is_file()


def test_names_and_files_are_resolved(tmp_path: Path) -> None:
    words = resolve_recipe(split_words(["config=train_paper", "steps=3", "--batch_size=2"]))
    assert words.settings == [("config_path", str(recipes()["train_paper"])), ("steps", "3")]
    assert words.flags == ["--batch_size=2"]
    own = tmp_path / "mine.yaml"
    own.write_text("steps: 1\n")
    assert recipe_file(str(own)) == own
    with pytest.raises(MemobenchError, match="train_contrastive"):
        recipe_file("train_contrastiv")
    with pytest.raises(MemobenchError, match="no such file"):
        recipe_file("nowhere/mine.yaml")
    with pytest.raises(MemobenchError, match="one recipe"):
        resolve_recipe(split_words(["config=train_paper", "config_path=x.yaml"]))


def test_an_unknown_recipe_costs_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    from lerobot_memobench.cli.lerobot import main

    assert main(["train", "config=train_papr"]) == 2
    assert "train_paper" in capsys.readouterr().err
    assert "lerobot.scripts" not in sys.argv[0]
