"""The history of a rollout: each row by its own clock."""

from __future__ import annotations

import torch

from lerobot_memobench.policies.memobench_mem.memory.frame_sampling import FrameSampling
from lerobot_memobench.policies.memobench_mem.memory.mechanism import RolloutMemory


def _encode(values: list[float]):  # type: ignore[no-untyped-def]
    return lambda rows: torch.stack([torch.full((16, 2), values[row]) for row in rows])


def acting(*steps: int) -> list[tuple[int, int]]:
    """Return the clocks of rows in their execution."""
    return [(1, step) for step in steps]


def test_rows_start_freeze_and_stay_apart() -> None:
    memory, new, old = RolloutMemory(FrameSampling(4), stride=1), True, False
    assert memory.observe(acting(0, 0), _encode([1.0, 2.0])) == ([0, 0], [new, new], [False, False])
    assert memory.observe(acting(1, 0), _encode([3.0, 99.0])) == ([1, 0], [old, old], [False, True])  # row 1 frozen
    assert memory.observe(acting(2, 1), _encode([5.0, 4.0])) == ([2, 1], [old, old], [False, False])
    assert memory.observe(acting(0, 2), _encode([7.0, 6.0])) == ([0, 2], [new, old], [False, False])  # row 0 begins
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
        memory.observe(acting(step), _encode([float(step)]))
    tokens, steps, mask = memory.gather([0])
    assert steps.tolist() == [[0, 6, 12, 18]]
    assert mask.all()
    assert [float(t[0, 0]) for t in tokens[0]] == [0, 6, 12, 18]
    memory.reset()
    assert memory.rows == []


def test_a_frame_that_was_not_offered_is_noticed() -> None:
    memory = RolloutMemory(FrameSampling(4), stride=4)
    for step in (0, 3, 4, 4, 6, 8):  # what lies between two frames that are written may be left out
        memory.observe(acting(step, 1), _encode([1.0, 1.0]))
    assert memory.missed([0, 1]) is None
    memory.observe(acting(13, 6), _encode([1.0, 1.0]))
    assert (memory.missed([0]), memory.missed([1]), memory.missed([0, 1])) == (12, 4, 4)
    memory.observe(acting(14, 0), _encode([1.0, 1.0]))
    assert (memory.missed([0]), memory.missed([1])) == (12, None), "a new episode has missed nothing"


def test_the_clock_starts_again_with_the_execution() -> None:
    """The prompt's frames stay in the history, whose own time goes on; a clock that counts through tells the same."""
    for first in (0, 3):
        memory = RolloutMemory(FrameSampling(9), stride=1)
        clocks = [(0, 0), (0, 1), (0, 2), (1, first), (1, first + 1), (1, first + 1), (1, first + 3)]
        found = [memory.observe([clock], _encode([1.0])) for clock in clocks]
        assert [steps for steps, _, _ in found] == [[0], [1], [2], [3], [4], [4], [6]]
        assert [started for _, started, _ in found] == [[True], *[[False]] * 6]
        assert [frozen for _, _, frozen in found] == [[False]] * 5 + [[True], [False]]
        assert memory.observe([(0, 0)], _encode([1.0])) == ([0], [True], [False])
        assert len(memory.rows[0].kept) == 1


def test_an_execution_without_a_prompt_begins_again_at_step_0() -> None:
    memory = RolloutMemory(FrameSampling(4), stride=1)
    for clock, began in (((1, 0), True), ((1, 1), False), ((1, 0), True), ((1, 0), False)):
        assert memory.observe([clock], _encode([1.0]))[1] == [began]
