"""The golden frame: this machine's pictures are the benchmark's."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.doctor.golden import SIDE, TOLERANCE, difference, read_golden, render_golden, shrink


def test_this_machine_renders_the_golden_frame() -> None:
    assert difference(render_golden(), read_golden()) < TOLERANCE / 2


def test_wrong_pictures_are_outside_the_tolerance() -> None:
    golden = read_golden()
    assert golden.shape == (SIDE, SIDE, 3)
    grey = np.repeat(golden.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    for wrong in (golden[::-1], golden[:, ::-1], golden[..., ::-1], grey, golden // 2, np.zeros_like(golden)):
        assert difference(wrong, golden) > TOLERANCE


def test_shrinking_averages_blocks() -> None:
    image = np.zeros((2 * SIDE, 2 * SIDE, 3), dtype=np.uint8)
    image[::2] = 100
    assert (shrink(image) == 50).all()
