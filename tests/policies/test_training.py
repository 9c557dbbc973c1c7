"""lerobot-train's own loop on the policy: it runs, logs, saves, goes on, and its loss falls."""

from __future__ import annotations

import json
import logging
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_train import train
from safetensors import safe_open

from lerobot_memobench.policies.memobench_mem import training
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.run.training import trained_on
from tests.support.synthetic_dataset import make_dataset


def _config(root: Path, output: Path, steps: int, save_freq: int, **fields: Any) -> TrainPipelineConfig:
    return TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(root)),
        policy=MemobenchMemConfig(device="cpu", push_to_hub=False, **fields),
        output_dir=output,
        steps=steps,
        batch_size=8,
        num_workers=0,
        log_freq=max(1, steps // 5),
        save_freq=save_freq,
    )


def _updates(checkpoint: Path) -> int:
    with safe_open(checkpoint / "pretrained_model" / "training_weights.safetensors", framework="pt") as file:
        return int(file.metadata()["updates"])


def _logged(caplog: pytest.LogCaptureFixture, name: str) -> list[float]:
    # The text, written when it was logged: the records hold the tracker, which has been reset since.
    lines = [line for line in caplog.text.splitlines() if "smpl:" in line]
    return [float(match[1]) for line in lines if (match := re.search(rf"\b{name}:(-?[\d.]+)", line))]


@pytest.fixture
def logs(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> pytest.LogCaptureFixture:
    # LeRobot replaces the root logger's handlers, and with them pytest's.
    monkeypatch.setattr("lerobot.scripts.lerobot_train.init_logging", lambda **_: None)
    caplog.set_level(logging.INFO)
    return caplog


def test_training_saves_and_goes_on(
    dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logs: pytest.LogCaptureFixture
) -> None:
    train(
        _config(dataset_root, tmp_path / "run", steps=4, save_freq=2, align="framewise", chunk_size=8, n_action_steps=8)
    )
    assert len(_logged(logs, "loss")) == len(_logged(logs, "align_top1")) == 4
    checkpoints = tmp_path / "run" / "checkpoints"
    assert (_updates(checkpoints / "000002"), _updates(checkpoints / "000004")) == (2, 4)
    config_path = checkpoints / "000002" / "pretrained_model" / "train_config.json"
    monkeypatch.setattr(sys, "argv", ["lerobot-train", f"--config_path={config_path}", "--resume=true", "--steps=3"])
    train()  # type: ignore[call-arg]
    assert _updates(checkpoints / "000003") == 3


def test_the_loss_of_held_out_episodes_lies_beside_the_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logs: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(training, "WINDOW", 2)
    config = _config(make_dataset(tmp_path / "two", repeats=2), tmp_path / "run", 4, 4, chunk_size=8)
    config.dataset.eval_split, config.eval_steps = 0.5, 2
    with trained_on(None):
        train(config)
    numbers = json.loads((tmp_path / "run/checkpoints/000004/pretrained_model" / training.NUMBERS).read_text())
    lerobots = [float(loss) for loss in re.findall(r"eval_loss=([\d.]+)", logs.text)]
    assert [look["updates"] for look in numbers["held_out"]] == [2, 4]
    assert [look["action_loss"] for look in numbers["held_out"]] == pytest.approx(lerobots, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("align", ["none", "semantic", "contrastive", "framewise"])
def test_loss_falls(dataset_root: Path, tmp_path: Path, logs: pytest.LogCaptureFixture, align: str) -> None:
    train(_config(dataset_root, tmp_path / "run", steps=50, save_freq=50, align=align))
    losses = _logged(logs, "action_loss")
    assert len(losses) == 5
    assert losses[-1] < 0.6 * losses[0]
    if align != "none":
        aligned = _logged(logs, "align_loss")
        assert aligned[-1] < 0.8 * aligned[0]
        assert all(norm > 0 for norm in _logged(logs, "align_grad_norm"))
