"""The weight average: its formula, its precision, and its state in a checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from torch import nn

from lerobot_memobench.training.average import TRAINING_FILE, WeightAverage


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


def test_average_of_a_new_part_starts_at_its_weights(tmp_path: Path) -> None:
    old = WeightAverage({"a": nn.Parameter(torch.ones(1))}, 0.9)
    old.update()
    old.save(tmp_path)
    new = WeightAverage({"a": nn.Parameter(torch.zeros(1)), "b": nn.Parameter(torch.full((1,), 3.0))}, 0.9)
    assert new.restore(tmp_path / TRAINING_FILE, {"a", "b"}) == ["b"]
    assert (new.counts, new.average["b"].item()) == ({"a": 1, "b": 0}, 3.0)
    new.save(tmp_path)
    again = WeightAverage(new.parameters, 0.9)
    again.restore(tmp_path / TRAINING_FILE, {"a", "b"})
    assert again.counts == {"a": 1, "b": 0}
