"""Training: it learns, and a run that was stopped ends as one that was not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.eyes.labels import Rows
from lerobot_memobench.eyes.pictures import Pictures
from lerobot_memobench.eyes.tower import Tower
from lerobot_memobench.eyes.training import CHECKPOINT, CURVE, Training, changed, train
from lerobot_memobench.eyes.weights import READINGS

from .made_up import made_up

KINDS = ("red", "green", "blue")


class Stopped(Exception):
    """What a killed process looks like from inside."""


@pytest.fixture
def pictures(tmp_path: Path) -> Pictures:
    """Twelve pictures on disk."""
    np.save(tmp_path / "pictures.npy", made_up(12))
    return Pictures([tmp_path / "pictures.npy"])


def test_a_stopped_run_ends_as_another(
    pictures: Pictures, small_tower: Callable[[], Tower], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Training(updates=12, batch=4)
    whole = train(pictures, KINDS, tmp_path / "whole", settings, tower=small_tower, save_every=2)
    read, asked = Pictures.rows, []

    def rows(self: Pictures, indices: np.ndarray) -> Rows:
        asked.append(1)
        if len(asked) == 8:
            raise Stopped
        return read(self, indices)

    monkeypatch.setattr(Pictures, "rows", rows)
    with pytest.raises(Stopped):
        train(pictures, KINDS, tmp_path / "stopped", settings, tower=small_tower, save_every=2)
    stopped = train(pictures, KINDS, tmp_path / "stopped", settings, tower=small_tower, save_every=2)
    assert len(asked) == 8 + 12 - 6 + 1  # it went on from the checkpoint of update 6; one more whitens
    assert stopped.read_bytes() == whole.read_bytes()
    assert (tmp_path / "stopped" / CURVE).is_file()


def test_it_learns(pictures: Pictures, small_tower: Callable[[], Tower], tmp_path: Path) -> None:
    settings = Training(updates=60, batch=4, rate=1e-2)
    train(pictures, KINDS, tmp_path / "run", settings, tower=small_tower, save_every=60)
    points = torch.load(tmp_path / "run" / CHECKPOINT, weights_only=True)["points"]
    assert len(points) == 6
    assert all(points[-1][name] < 0.8 * points[0][name] for name in points[0]), points
    assert {name.split()[0] for name in points[0]} == set(READINGS)


def test_other_settings_do_not_go_on(pictures: Pictures, small_tower: Callable[[], Tower], tmp_path: Path) -> None:
    train(pictures, KINDS, tmp_path, Training(updates=1, batch=2), tower=small_tower, save_every=1)
    with pytest.raises(MemobenchError, match="is of a training with"):
        train(pictures, KINDS, tmp_path, Training(updates=2, batch=2), tower=small_tower)


def test_changed_pictures_stay_pictures() -> None:
    images = torch.rand(4, 3, 16, 16)
    seen = changed(images, torch.Generator().manual_seed(0))
    assert seen.min() >= 0
    assert seen.max() <= 1
    assert torch.equal(seen, changed(images, torch.Generator().manual_seed(0)))
    assert 0.005 < float((seen - images).abs().mean()) < 0.15
