"""Vectors and rotations of the hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_memobench.experts.hand import (
    DOWN,
    MAX_OPENING_STEPS,
    NEUTRAL_CLOSING,
    OPEN,
    Hand,
    cross,
    downward,
    frame,
    length,
    unit,
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_small_vector_helpers_agree_with_numpy(rng: np.random.Generator) -> None:
    for _ in range(20):
        a, b = rng.normal(size=(2, 3))
        np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-12)
        assert length(a) == pytest.approx(np.linalg.norm(a))
        np.testing.assert_allclose(unit(a), a / np.linalg.norm(a))
    np.testing.assert_array_equal(unit(np.zeros(3)), np.zeros(3))


def test_frame_is_a_rotation_along_the_given_axes(rng: np.random.Generator) -> None:
    for _ in range(20):
        approach, closing = rng.normal(size=(2, 3))
        turn = frame(approach, closing)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        np.testing.assert_allclose(turn[:, 2], approach / np.linalg.norm(approach))
        assert turn[:, 0] @ closing > 0
        assert abs(np.linalg.det(np.stack([turn[:, 0], approach, closing]))) < 1e-9


@pytest.mark.parametrize("yaw", np.linspace(-np.pi, 3 * np.pi, 25))
def test_downward_rotation(yaw: float) -> None:
    turn = downward(float(yaw))
    np.testing.assert_allclose(turn[:, 2], DOWN, atol=1e-12)
    assert abs(turn[:, 0] @ [np.cos(yaw), np.sin(yaw), 0.0]) == pytest.approx(1.0)
    assert turn[:, 0] @ NEUTRAL_CLOSING > -1e-9


@pytest.mark.parametrize(("kept_shut", "most"), [(0, 3), (9, 12), (500, MAX_OPENING_STEPS)])
def test_waits_for_late_opening_fingers(
    kept_shut: int, most: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three steps with an opening command count; steps in which the command stays closed do not."""
    commands = iter([1.0] * (kept_shut + 1) + [0.75, 0.5, 0.25])
    sim = SimpleNamespace(eef_pose=lambda: (np.zeros(3), np.eye(3)), command=1.0)
    sim.gripper_command = lambda: sim.command
    monkeypatch.setattr(Hand, "toward", lambda self, position, rotation, gripper: np.full(7, gripper, np.float32))
    actions = []
    next(commands)
    for action in Hand(sim, rng).open(3):
        actions.append(action)
        sim.command = next(commands)
    assert len(actions) == most
    assert {float(action[6]) for action in actions} == {OPEN}
