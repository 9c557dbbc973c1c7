"""Vectors and rotations of the hand."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_memobench.experts.hand import DOWN, EASY_CLOSING, cross, downward, frame, length, unit


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


def test_frame_is_a_rotation_that_points_where_it_is_told(rng: np.random.Generator) -> None:
    for _ in range(20):
        approach, closing = rng.normal(size=(2, 3))
        turn = frame(approach, closing)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        np.testing.assert_allclose(turn[:, 2], approach / np.linalg.norm(approach))
        assert turn[:, 0] @ closing > 0
        assert abs(np.linalg.det(np.stack([turn[:, 0], approach, closing]))) < 1e-9


@pytest.mark.parametrize("yaw", np.linspace(-np.pi, 3 * np.pi, 25))
def test_downward_closes_along_the_angle_the_easy_way_round(yaw: float) -> None:
    turn = downward(float(yaw))
    np.testing.assert_allclose(turn[:, 2], DOWN, atol=1e-12)
    assert abs(turn[:, 0] @ [np.cos(yaw), np.sin(yaw), 0.0]) == pytest.approx(1.0)
    assert turn[:, 0] @ EASY_CLOSING > -1e-9
