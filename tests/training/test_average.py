"""The weight average: its formula, its precision, and its state in a checkpoint."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from lerobot_memobench.training.average import WeightAverage, states_of


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


def test_bfloat16_weights_have_a_saved_float32_average() -> None:
    weight = nn.Parameter(torch.tensor([1.0], dtype=torch.bfloat16))
    average = WeightAverage({"w": weight}, 0.999)
    average.update()
    assert average.average["w"].dtype == torch.float32
    tensors, metadata = average.state()
    assert set(tensors) == {"weights.w", "average.w"}
    again = WeightAverage({"w": nn.Parameter(torch.zeros(1, dtype=torch.bfloat16))}, 0.999)
    assert again.restore(states_of(tensors, metadata)) == []
    assert again.counts == {"w": 1}
    assert torch.equal(again.parameters["w"].data, weight.data)


def test_average_of_a_new_part_starts_at_its_weights() -> None:
    old = WeightAverage({"a": nn.Parameter(torch.ones(1))}, 0.9)
    old.update()
    new = WeightAverage({"a": nn.Parameter(torch.zeros(1)), "b": nn.Parameter(torch.full((1,), 3.0))}, 0.9)
    assert new.restore(states_of(*old.state())) == ["b"]
    assert (new.counts, new.average["b"].item()) == ({"a": 1, "b": 0}, 3.0)
    assert states_of(*new.state())["b"].updates == 0
