"""The history of a rollout: each row by its own clock."""

from __future__ import annotations

import torch

from lerobot_memobench.policies.memobench_mem.memory.frame_sampling import FrameSampling
from lerobot_memobench.policies.memobench_mem.memory.rollout import RolloutMemory


def _encode(values: list[float]):  # type: ignore[no-untyped-def]
    return lambda rows: torch.stack([torch.full((16, 2), values[row]) for row in rows])


def test_rows_start_freeze_and_stay_apart() -> None:
    memory = RolloutMemory(FrameSampling(4), stride=1)
    assert memory.observe([0, 0], _encode([1.0, 2.0])) == ([True, True], [False, False])
    assert memory.observe([1, 0], _encode([3.0, 99.0])) == ([False, False], [False, True])  # row 1 frozen
    assert memory.observe([2, 1], _encode([5.0, 4.0])) == ([False, False], [False, False])
    assert memory.observe([0, 2], _encode([7.0, 6.0])) == ([True, False], [False, False])  # row 0 begins again
    tokens, steps, mask = memory.gather([0, 1])
    assert steps.tolist() == [[0, 0, 0, 0], [0, 1, 2, 0]]
    assert mask.tolist() == [[True, False, False, False], [True, True, True, False]]
    assert tokens[0, 0, 0, 0] == 7
    assert [float(t[0, 0]) for t in tokens[1]] == [2, 4, 6, 0]
    alone, _, _ = memory.gather([1])
    assert torch.equal(alone[0], tokens[1])


def test_stride_and_sampling_of_a_long_history() -> None:
    memory = RolloutMemory(FrameSampling(4), stride=3)
    for step in range(20):
        memory.observe([step], _encode([float(step)]))
    tokens, steps, mask = memory.gather([0])
    assert steps.tolist() == [[0, 6, 12, 18]]
    assert mask.all()
    assert [float(t[0, 0]) for t in tokens[0]] == [0, 6, 12, 18]
    memory.reset()
    assert memory.rows == []
