"""How much of a plan is carried out."""

from __future__ import annotations

import pytest
import torch

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import ActionQueues

STATE = torch.tensor([0.1, 0.2, 1.0, 3.13, 0.1, 0.0, 0.04, -0.04])
AXIS = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0])


def carried_out(*states: torch.Tensor | None) -> list[int]:
    """Return how much is carried out of plans of 16 actions, made one after another where the robot is so."""
    plans, counts = ActionQueues(7), []
    plans.resize(1)
    for state in states:
        plans.begin(0, torch.zeros(16, 7), 6, state)
        counts.append(len(plans.queues[0]))
        plans.queues[0].clear()
    return counts


def moved(index: int, by: float) -> torch.Tensor:
    return STATE + by * torch.eye(8)[index]


@pytest.mark.parametrize(
    "where", [STATE, moved(2, 0.005), moved(6, 0.005), moved(4, 0.05), STATE - 2 * STATE * AXIS * 1.0035]
)
def test_a_hand_that_stands_still_carries_out_all(where: torch.Tensor) -> None:
    """The last one is turned by nearly the same angle, past half a turn: its axis points the other way."""
    assert carried_out(STATE, where) == [6, 16]


@pytest.mark.parametrize("where", [moved(2, 0.01), moved(7, 0.01), moved(4, 0.2)])
def test_a_hand_or_a_finger_that_moves_carries_out_some(where: torch.Tensor) -> None:
    assert carried_out(STATE, where) == [6, 6]


def test_without_a_state_and_after_a_plan_was_dropped_it_is_some() -> None:
    assert carried_out(None, None) == [6, 6]
    plans = ActionQueues(7)
    plans.resize(1)
    plans.begin(0, torch.zeros(16, 7), 6, STATE)
    plans.drop(0)
    plans.begin(0, torch.zeros(16, 7), 6, STATE)
    assert len(plans.queues[0]) == 6
