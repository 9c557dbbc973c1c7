"""Differences of two versions of MuJoCo, counted by hand; a version equals itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from research.mujoco_versions.study import compare, run_both, table

TASK = "open_and_close_the_microwave"


def side(out: Path, mujoco: str, **changes: Any) -> None:
    """Write the results of a side: two episodes of a scene of three bodies and pictures of 2 × 2 pixels."""
    columns = {
        "seed": np.array([7, 8]),
        "start": np.zeros((2, 3, 3)),
        "end": np.zeros((2, 3, 3)),
        "image": np.zeros((2, 2, 2, 3), np.uint8),
        "wrist_image": np.zeros((2, 2, 2, 3), np.uint8),
        "solved": np.array([True, True]),
        "steps": np.array([100, 200]),
    }
    out.mkdir(parents=True)
    np.savez(out / f"{TASK}.npz", **{**columns, **changes}, mujoco=np.array(mujoco))


def test_what_differs_is_counted(tmp_path: Path) -> None:
    end = np.zeros((2, 3, 3))
    end[1, 2] = [0.003, 0.0, 0.004]
    image = np.zeros((2, 2, 2, 3), np.uint8)
    image[0, 0, 0] = [3, 0, 9]
    side(tmp_path / "here", "3.9.0")
    side(tmp_path / "there", "4.0.0", end=end, image=image, solved=np.array([True, False]), steps=np.array([100, 201]))
    versions, drifts = compare(tmp_path)
    assert versions == ("3.9.0", "4.0.0")
    assert [(drift.solved, drift.steps) for drift in drifts] == [
        ((True, True), (100, 100)),
        ((True, False), (200, 201)),
    ]
    assert [drift.start for drift in drifts] == [0.0, 0.0]
    assert [drift.end for drift in drifts] == [0.0, 0.005]
    assert [drift.pixels for drift in drifts] == [1 / 8, 0.0]
    assert [drift.shade for drift in drifts] == [12 / 24, 0.0]
    written = table(versions, drifts)
    assert "| published | 2 | 2 | 1 | 1 | 0, 0, 0 | 2.5, 4.5, 5 |" in written
    assert written.endswith(f"- {TASK}, seed 8: solved under 3.9.0 alone")


def test_sides_of_several_versions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="0 pairs"):
        compare(tmp_path)


def test_the_other_mujoco_is_a_folder(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="not a folder"):
        run_both(tmp_path / "nowhere", tmp_path / "out", 1)


@pytest.mark.slow
def test_the_same_mujoco_differs_in_nothing(tmp_path: Path) -> None:
    (tmp_path / "packages").mkdir()
    run_both(tmp_path / "packages", tmp_path / "out", 1, [TASK])
    _, (drift,) = compare(tmp_path / "out")
    assert drift.solved == (True, True)
    assert (drift.start, drift.end, drift.pixels, drift.shade) == (0.0, 0.0, 0.0, 0.0)
