"""The paper's recipe: its values, and every row and control of the paper trains by overriding it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import AdamWConfig

import lerobot_policy_memobench  # noqa: F401  (registers the policy and the environment)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.arguments import recipe_file, recipes, resolve_recipe, split_arguments

RECIPE = "train_paper"
WEIGHTS = {"semantic": 0.1, "contrastive": 0.1, "framewise": 0.05}
ROWS: dict[str, list[str]] = {
    "memory module": [],
    **{name: [f"policy.align={name}"] for name in WEIGHTS},
    "pi05": ["policy.memory_fusion=none"],
    "context": ["policy.memory_fusion=context"],
    "oracle memory": ["policy.memory_fusion=none", "policy.oracle_memory=true"],
    "coarse": ["policy.align=contrastive", "policy.subgoal_level=coarse"],
    "fine": ["policy.align=contrastive", "policy.subgoal_level=fine"],
    "shuffled": ["policy.align=contrastive", "policy.subgoal_level=coarse", "policy.shuffle_subgoals=true"],
    "random referents": ["env.type=memobench", "env.referent=random"],
}
"""Row or control of the paper -> what it overrides."""


def _parse(*overrides: str) -> TrainPipelineConfig:
    """As lerobot-train parses a file and its flags; on a CPU, whatever this machine has."""
    flags = [f"--{override}" for override in ("policy.device=cpu", *overrides)]
    return TrainPipelineConfig.from_pretrained(recipe_file(RECIPE), cli_args=flags)


def _tiny(row: str, root: Path, out: Path) -> list[str]:
    """The command line that trains a recipe for two steps on a CPU."""
    return [
        "train",
        f"config={RECIPE}",
        *ROWS[row],
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


def _train(row: str, root: Path, out: Path) -> Path:
    from lerobot_memobench.cli.lerobot import main

    assert main(_tiny(row, root, out)) == 0
    return out / "checkpoints" / "000002" / "pretrained_model"


@pytest.mark.slow
@pytest.mark.parametrize("row", [row for row in ROWS if row != "framewise"])
def test_every_row_trains(row: str, dataset_root: Path, tmp_path: Path) -> None:
    checkpoint = _train(row, dataset_root, tmp_path / "run")
    assert (checkpoint / "model.safetensors").is_file()


def test_names_and_files_are_resolved(tmp_path: Path) -> None:
    words = resolve_recipe(split_arguments(["config=train_paper", "steps=3", "--batch_size=2"]))
    assert words.pairs == [("config_path", str(recipes()["train_paper"])), ("steps", "3")]
    assert words.flags == ["--batch_size=2"]
    own = tmp_path / "mine.yaml"
    own.write_text("steps: 1\n")
    assert recipe_file(str(own)) == own
    with pytest.raises(MemobenchError, match="train_paper"):
        recipe_file("train_papr")
    with pytest.raises(MemobenchError, match="no such file"):
        recipe_file("nowhere/mine.yaml")
    with pytest.raises(MemobenchError, match="one recipe"):
        resolve_recipe(split_arguments(["config=train_paper", "config_path=x.yaml"]))


def test_an_unknown_recipe_costs_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    from lerobot_memobench.cli.lerobot import main

    assert main(["train", "config=train_papr"]) == 2
    assert "train_paper" in capsys.readouterr().err
    assert "lerobot.scripts" not in sys.argv[0]


@pytest.mark.parametrize("row", ROWS)
def test_values_are_the_papers(row: str) -> None:
    config = _parse("output_dir=/tmp/never-made", *ROWS[row])
    config.validate()  # where LeRobot takes the policy's presets
    policy: Any = config.policy
    optimizer: Any = config.optimizer
    assert (optimizer.lr, optimizer.betas, optimizer.weight_decay, optimizer.grad_clip_norm) == (
        5e-5,
        (0.9, 0.95),
        0.0,
        1.0,
    )
    assert isinstance(optimizer, AdamWConfig)
    schedule: Any = config.scheduler
    assert (schedule.type, schedule.warmup_fraction) == ("memobench_constant_with_warmup", 0.05)
    assert (config.batch_size, config.steps, config.save_freq) == (64, 80_000, 10_000)
    assert (policy.ema_decay, policy.dtype, policy.gradient_checkpointing) == (0.999, "bfloat16", True)
    assert (policy.size, policy.image_resolution) == ("pi05", (224, 224))
    assert (policy.memory_frames, policy.tokens_per_frame, policy.chunk_size) == (32, 16, 50)
    for override in ROWS[row]:
        key, _, value = override.partition("=")
        section, field = key.split(".")
        assert str(getattr(getattr(config, section), field)).lower() == value, key
