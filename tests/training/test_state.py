"""State of a training in its checkpoint: step, optimizer, schedule, weight average; a log without W&B."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from accelerate import Accelerator
from lerobot.configs.default import WandBConfig
from lerobot.optim import load_optimizer_state, load_scheduler_state
from lerobot.utils.random_utils import load_rng_state
from safetensors import safe_open
from torch import nn, optim

from lerobot_memobench.training.loop import TRAINING_FILE, TrainingLog, WeightAverage, load_state, save_state
from tests.training.conftest import read_losses


def made(updates: int) -> tuple[optim.Optimizer, Any]:
    weight = nn.Parameter(torch.ones(3))
    optimizer = optim.AdamW([weight], lr=0.1)
    schedule = optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 / (1 + step))
    for _ in range(updates):
        weight.square().sum().backward()
        optimizer.step()
        schedule.step()
    return optimizer, schedule


def test_state_is_restored_and_lerobot_reads_it(tmp_path: Path) -> None:
    optimizer, schedule = made(4)
    save_state(tmp_path, {"step": 4, "batch_size": 6, "num_processes": 2}, optimizer, schedule)
    following = torch.rand(3)
    folder = tmp_path / "training_state"
    assert {path.name for path in folder.iterdir()} == {
        *("training_step.json", "rng_state.safetensors", "scheduler_state.json"),
        *("optimizer_state.safetensors", "optimizer_param_groups.json"),
    }
    ours, theirs = made(0), made(0)
    progress = load_state(tmp_path, *ours)
    assert (progress["step"], progress["batch_size"], progress["num_processes"]) == (4, 6, 2)
    assert json.loads((folder / "training_step.json").read_text())["dp_world_size"] == 2
    load_optimizer_state(theirs[0], folder)
    load_scheduler_state(theirs[1], folder)
    for found in (ours, theirs):
        assert found[1].get_last_lr() == schedule.get_last_lr()
        for name, value in found[0].state_dict()["state"][0].items():
            assert torch.equal(value, optimizer.state_dict()["state"][0][name])
    load_rng_state(folder)
    assert torch.equal(torch.rand(3), following)


def test_log_needs_no_wandb(tmp_path: Path) -> None:
    config = SimpleNamespace(output_dir=tmp_path, batch_size=4, steps=2, wandb=WandBConfig())
    dataset = SimpleNamespace(num_frames=40, num_episodes=2)
    log = TrainingLog(cast(Any, config), cast(Any, dataset), Accelerator(cpu=True), 0)
    log.note({"loss": 1.5, "grad_norm": 1.0, "lr": 0.1, "update_s": 0.01})
    log.write(1)
    log.write_evaluation(1, {"overall": {"avg_sum_reward": 0.0, "pc_success": 50.0, "eval_s": 1.0}})
    log.keep_model(tmp_path)
    log.close()
    found = {row[2]: row[3] for row in read_losses(tmp_path)}
    assert (found["loss"], found["pc_success"]) == (1.5, 50.0)


def test_average_follows_its_formula() -> None:
    weight = nn.Parameter(torch.tensor([0.0]))
    average, expected = WeightAverage({"w": weight}, 0.9), 0.0
    for update in range(200):
        weight.data += 1.0
        average.update()
        decay = min(0.9, (1 + update) / (10 + update))
        expected = decay * expected + (1 - decay) * weight.item()
        assert average.average["w"].item() == pytest.approx(expected)
    with average.applied():
        assert weight.item() == pytest.approx(expected)
    assert weight.item() == 200


def test_bfloat16_weights_have_a_saved_float32_average(tmp_path: Path) -> None:
    weight = nn.Parameter(torch.tensor([1.0], dtype=torch.bfloat16))
    average = WeightAverage({"w": weight}, 0.999)
    average.update()
    assert average.average["w"].dtype == torch.float32
    average.save(tmp_path)
    with safe_open(tmp_path / TRAINING_FILE, framework="pt") as file:
        assert set(file.keys()) == {"weights.w", "average.w"}
    again = WeightAverage({"w": nn.Parameter(torch.zeros(1, dtype=torch.bfloat16))}, 0.999)
    assert again.restore(tmp_path / TRAINING_FILE, {"w"}) == []
    assert again.counts == {"w": 1}
    assert torch.equal(again.parameters["w"].data, weight.data)
