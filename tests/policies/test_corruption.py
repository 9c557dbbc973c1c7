"""`corrupt_memory`: deleted, swapped and noisy memories of a row, for each mechanism; other rows stay unchanged."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from lerobot_memobench.policies.memobench_mem.memory import OURS
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens
from lerobot_memobench.policies.memobench_mem.rollout import Rollout
from tests.policies.test_memory import assert_same, made, present

ROWS, STRIDE, LENGTH = 3, 4, 12


class Rolled:
    """Rows that remember random frames, and what they read."""

    def __init__(self, name: str) -> None:
        self.mechanism = made(name, stride=STRIDE)
        self.query = present(ROWS)
        self.rollout = Rollout(True, STRIDE)
        generator = torch.Generator().manual_seed(3)
        self.frames = torch.randn(ROWS, 3 * LENGTH, 1, 6, generator=generator)

    def write(self, rows: list[int]) -> None:
        for row in rows:
            held = self.rollout.envs[row]
            state = self.mechanism.init(1) if held.memory is None else held.memory
            query = self.query.rows([row])._replace(tokens=None)
            frame = self.frames[row, held.position][None]
            held.memory = self.mechanism.observe(state, frame, torch.tensor([held.position]), query)

    def act(self, steps: range) -> None:
        for step in steps:
            self.rollout.observe([(0, step)] * ROWS, self.write)

    def read(self, row: int) -> MemoryTokens:
        with torch.no_grad():
            return self.mechanism.read(self.rollout.envs[row].memory, self.query.rows([row]))


@pytest.fixture(params=OURS)
def rolled(request: pytest.FixtureRequest) -> Rolled:
    found = Rolled(request.param)
    with torch.no_grad():
        found.act(range(LENGTH))
    return found


@torch.no_grad()
def test_a_deleted_memory_begins_with_the_next_frame(rolled: Rolled) -> None:
    rolled.rollout.corrupt([1], lambda row: None)
    rolled.act(range(LENGTH + 1, LENGTH + 2))  # not a step of the stride
    step, frame = LENGTH + 1, rolled.frames[1, LENGTH + 1][None]
    query = rolled.query.rows([1])
    fresh = rolled.mechanism.observe(rolled.mechanism.init(1), frame, torch.tensor([step]), query._replace(tokens=None))
    assert_same(rolled.read(1), rolled.mechanism.read(fresh, query))


@torch.no_grad()
def test_rows_swap_the_memories_that_they_had_before(rolled: Rolled) -> None:
    before = [rolled.rollout.envs[row].memory for row in range(ROWS)]
    rolled.rollout.corrupt([0], rolled.rollout.next_env_memory)
    rolled.rollout.corrupt([1, 2], rolled.rollout.next_env_memory)  # the first row has row 1's memory by now
    for row in range(ROWS):
        assert rolled.rollout.envs[row].memory is before[(row + 1) % ROWS]


@torch.no_grad()
def test_noise_changes_what_a_row_reads_and_no_other(rolled: Rolled) -> None:
    def noised(row: int) -> Any:
        return rolled.mechanism.noised(rolled.rollout.envs[row].memory, torch.Generator().manual_seed(5))

    before = [rolled.read(row) for row in range(ROWS)]
    rolled.rollout.corrupt([1], noised)
    first = rolled.read(1)
    if rolled.mechanism.reads_text:  # the text changes with the next frame at the earliest
        held = rolled.rollout.envs[1]
        assert not torch.equal(held.memory["frames"], held.intact["frames"])
    else:
        assert float((before[1].rows() - first.rows()).abs().max()) > 1e-3
    assert first.steps is None or torch.equal(first.steps, before[1].steps)
    for row in (0, 2):
        assert_same(rolled.read(row), before[row])
    rolled.rollout.envs[1].memory = rolled.rollout.envs[1].intact
    rolled.rollout.corrupt([1], noised)
    assert_same(rolled.read(1), first)
