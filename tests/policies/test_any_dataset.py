"""``memobench_mem`` on datasets of other robots: any cameras, joints and rates; no phases, subgoals or clock."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.common.control_utils import predict_action
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.commands.command_line import parse_words, read_words
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import modeling_memobench_mem
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.training import loop
from lerobot_memobench.training.command import complete_training
from tests.support.synthetic_dataset import drawn_frame, write_robot

IMAGES, STATE = "observation.images.", "observation.state"


def train(root: Path, out: Path, *flags: str, size: str = "tiny") -> Path:
    own = ["--policy.type=memobench_mem", f"--policy.size={size}", "--policy.memory_settings={frames: 4}"]
    usual = [
        *("--dataset.repo_id=somebody/robot", f"--dataset.root={root}", f"--output_dir={out}"),
        *("--steps=2", "--save_freq=2", "--batch_size=2", "--num_workers=0", "--policy.device=cpu"),
        "--policy.push_to_hub=false",
    ]
    asked = read_words("train", parse_words([*own, *usual, *flags]))
    loop.train(complete_training(asked))
    return out / "checkpoints" / "last" / "pretrained_model"


THREE = dict.fromkeys((IMAGES + name for name in ("left", "top", "gripper")), (96, 96))


@pytest.mark.parametrize(
    ("cameras", "state", "action", "fps", "size"),
    [
        ({"observation.image": (96, 96)}, 2, 2, 10, "tiny"),
        pytest.param(
            {IMAGES + "front": (240, 240), IMAGES + "b": (120, 120)}, 14, 7, 30, "small", marks=pytest.mark.slow
        ),
    ],
)
def test_datasets_of_other_robots(
    cameras: dict[str, tuple[int, int]], state: int, action: int, fps: int, size: str, tmp_path: Path
) -> None:
    checkpoint = train(write_robot(tmp_path / "data", cameras, state, action, fps), tmp_path / "run", size=size)
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    policy: Any = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    rng, cpu = np.random.default_rng(1), torch.device("cpu")
    policy.reset()
    for _ in range(5):
        seen = drawn_frame(rng, cameras, **{STATE: state})
        found = predict_action(seen, policy, cpu, before, after, False, "fold the towel", "arm")
        assert found.shape == (1, action)
        assert found.isfinite().all()
    assert config.memory_camera == next(iter(cameras))
    policy.write_kept()
    stored = [frame.step for frame in policy.rollout.envs[0].memory[0]]
    assert stored == [*range(0, 5, config.memory_stride)]


# --- names ---


def test_memory_camera_is_an_input() -> None:
    features = {name: PolicyFeature(FeatureType.VISUAL, (3, *size)) for name, size in THREE.items()}
    config = MemobenchMemConfig(device="cpu", input_features=features)
    config.validate_features()
    assert config.memory_camera == IMAGES + "left"
    config = MemobenchMemConfig(device="cpu", input_features=features, memory_camera=IMAGES + "image")
    with pytest.raises(MemobenchError, match=r"memory_camera.*left, .*top, .*grip"):
        config.validate_features()


# --- missing parts ---


@pytest.mark.parametrize(
    ("extra", "flag", "named"),
    [
        ({}, "align=contrastive", "policy.align"),
        ({"subgoal.intermediate": ""}, "align=framewise", "subgoal.intermediate"),
        ({"subgoal.coarse": "fold"}, "align=semantic", "policy.subgoal_level"),
        ({}, "oracle_memory=true", "policy.oracle_memory"),
    ],
)
def test_missing_texts_are_refused_before_the_model_is_built(
    extra: dict[str, str], flag: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_robot(tmp_path / "data", {IMAGES + "top": (96, 96)}, 6, 6, **extra)
    monkeypatch.setattr(modeling_memobench_mem, "MemoryPI05", None)
    with pytest.raises(MemobenchError, match=named):
        train(root, tmp_path / "run", f"--policy.{flag}")
    assert not (root / "feature_cache").exists()


def test_states_longer_than_the_base_weights_are_refused() -> None:
    features = {STATE: PolicyFeature(FeatureType.STATE, (33,))}
    config = MemobenchMemConfig(device="cpu", input_features=dict(features))
    config.validate_features()
    assert config.max_state_dim == 33
    config = MemobenchMemConfig(device="cpu", input_features=dict(features), base_weights="lerobot/pi05_base")
    with pytest.raises(MemobenchError, match=r"33 .*32"):
        config.validate_features()


# --- the benchmark between updates ---


def test_evaluation_between_updates_needs_the_datasets_inputs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_robot(tmp_path / "data", {IMAGES + "image": (128, 128)}, 8, 7)
    words = ("policy=act", "policy.pretrained_backbone_weights=null", "env=memobench", "steps=1", "device=cpu")
    assert main(["train", *words, f"dataset={root}", f"output_dir={tmp_path / 'run'}"]) == 2
    assert re.search(f"{root}.*128 x 128", capsys.readouterr().err)
