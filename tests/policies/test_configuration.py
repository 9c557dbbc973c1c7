"""Configuration: defaults per size and objective, refusals, and the learning-rate schedule."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import configuration_memobench_mem
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig


@pytest.mark.parametrize(("kind", "fused"), [("cuda", True), ("cpu", True), ("mps", None)])
def test_the_optimizer_is_one_kernel(kind: str, fused: bool | None, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[dict[str, Any]] = []
    monkeypatch.setattr(configuration_memobench_mem, "AdamW", lambda *_, **options: made.append(options))
    MemobenchMemConfig(device="cpu").get_optimizer_preset().build(
        [SimpleNamespace(device=SimpleNamespace(type=kind))] * 2
    )  # type: ignore
    assert made == [{"fused": fused}]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"align": "contrstive"}, "contrastive"),
        ({"size": "tny"}, "tiny"),
        ({"memory_fusion": "modulate"}, "modulation"),
        ({"subgoal_level": "middle"}, "intermediate"),
        ({"memory_stride": 0}, "memory_stride"),
        ({"tokens_per_frame": 8}, "16"),
        ({"ema_decay": 1.0}, "ema_decay"),
        ({"image_resolution": (100, 100)}, "multiple of 48"),
    ],
)
def test_bad_values_are_refused_with_the_fix(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        MemobenchMemConfig(device="cpu", **fields)


def test_saved_and_read_again(tmp_path: Path) -> None:
    config = MemobenchMemConfig(align="framewise", memory_stride=4, device="cpu")
    config.save_pretrained(tmp_path)
    again = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--n_action_steps=20"])
    assert dataclasses.asdict(again) == dataclasses.asdict(config) | {"n_action_steps": 20}


def test_what_is_pi05s_alone_is_not_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's main adds such fields, which 0.6.1 would refuse in a checkpoint; a field of both replaces them."""
    monkeypatch.setattr(configuration_memobench_mem, "PI05_ALONE", ("compile_mode",))
    MemobenchMemConfig(device="cpu").save_pretrained(tmp_path)
    assert "compile_mode" not in json.loads((tmp_path / "config.json").read_text())
    assert PreTrainedConfig.from_pretrained(tmp_path) == MemobenchMemConfig(device="cpu")


def test_schedule_warms_up_over_a_twentieth_and_stays() -> None:
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = MemobenchMemConfig(device="cpu").get_scheduler_preset().build(optimizer, num_training_steps=200)
    rates = []
    for _ in range(200):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates[:10] == pytest.approx([(i + 1) / 10 for i in range(10)])
    assert set(rates[10:]) == {1.0}


def test_defaults_are_the_papers() -> None:
    config = MemobenchMemConfig(size="pi05", align="contrastive", device="cpu")
    assert config.type == "memobench_mem"
    assert (config.memory_frames, config.tokens_per_frame, config.chunk_size) == (32, 16, 50)
    assert config.ema_decay == 0.999
    assert config.image_resolution == (224, 224)
    optimizer = config.get_optimizer_preset()
    assert (optimizer.lr, optimizer.betas, optimizer.weight_decay, optimizer.grad_clip_norm) == (
        5e-5,
        (0.9, 0.95),
        0,
        1,
    )
