"""LeRobot's own memory, pi0.5's visual one: a training, a rollout, and what its queue takes in.

LeRobot 0.6.1 has none; `scripts/lerobot_main` makes an environment that does.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest
from lerobot.policies.factory import get_policy_class

from lerobot_memobench.cli.memobench import main as memobench
from tests.policies.test_looking import SIDES, STEPS, check, execution
from tests.policies.test_other_policies import TASK, _tiny_paligemma, train_and_roll_out  # noqa: F401 - a fixture
from tests.support.lerobot_policies import make_config

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("lerobot.policies.pi05.memory") is None, reason="this LeRobot's pi0.5 has no memory"
    ),
    pytest.mark.usefixtures("_tiny_paligemma"),
]

FRAMES, STRIDE, PLAN = 3, 2, 3
SIZES = {"chunk_size": 4, "n_action_steps": PLAN, "num_inference_steps": 2, "dtype": "float32"}
MEMORY = {"memory_frames": FRAMES, "memory_stride": STRIDE, "memory_temporal_attention_every": 1}


def pi05(**memory: Any) -> Any:
    return get_policy_class("pi05")(make_config("pi05", SIDES, **SIZES, **MEMORY, **memory))


def test_training_and_rollout(tmp_path: Path) -> None:
    data = tmp_path / "data"
    assert memobench(["generate", "--tasks", TASK, "--episodes", "1", "--out", str(data)]) == 0
    words = {**SIZES, **MEMORY, "use_visual_memory": "true", "tokenizer_max_length": 64}
    train_and_roll_out(data, tmp_path, "policy=pi05", *(f"policy.{name}={value}" for name, value in words.items()))


def test_visual_memory_needs_every_image() -> None:
    check(pi05(use_visual_memory=True), execution, range(STEPS))


def test_memory_of_states_needs_no_images() -> None:
    check(pi05(use_proprioceptive_memory=True), execution, range(0, STEPS, PLAN))
