"""Training: it learns, and a run that was stopped ends as one that was not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception import training
from lerobot_memobench.perception.labels import Rows, images_of
from lerobot_memobench.perception.pictures import Pictures
from lerobot_memobench.perception.targets import doubt_loss, sure_loss, targets
from lerobot_memobench.perception.tower import Tower
from lerobot_memobench.perception.training import CELLS, CHECKPOINT, CURVE, Training, changed, learn_last, train
from lerobot_memobench.perception.weights import READINGS, Eyes, load_eyes
from tests.support.made_up import made_up

KINDS = ("red", "green", "blue")
PARTS = ("around", "close", "near", "heard", "deeper", "sure")
LEARNED_LAST = {"fine_heads.doubt", *(f"second_look.{part}" for part in PARTS)}


class Stopped(Exception):
    """What a killed process looks like from inside."""


@pytest.fixture
def pictures(tmp_path: Path) -> Pictures:
    """Twelve pictures on disk."""
    np.save(tmp_path / "pictures.npy", made_up(12))
    return Pictures([tmp_path / "pictures.npy"])


@pytest.mark.parametrize(
    ("at", "again"),
    [
        pytest.param(8, 6 + 1 + 12, id="from update 6, then one read whitens and what is learned last takes twelve"),
        pytest.param(19, 1 + 8, id="from update 4 of what is learned last"),
    ],
)
def test_a_stopped_run_ends_as_another(
    at: int,
    again: int,
    pictures: Pictures,
    small_tower: Callable[[], Tower],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = Training(updates=12, batch=4)
    whole = train(pictures, KINDS, tmp_path / "whole", settings, tower=small_tower, save_every=2)
    read, asked = Pictures.rows, []

    def rows(self: Pictures, indices: np.ndarray) -> Rows:
        asked.append(1)
        if len(asked) == at:
            raise Stopped
        return read(self, indices)

    monkeypatch.setattr(Pictures, "rows", rows)
    with pytest.raises(Stopped):
        train(pictures, KINDS, tmp_path / "stopped", settings, tower=small_tower, save_every=2)
    stopped = train(pictures, KINDS, tmp_path / "stopped", settings, tower=small_tower, save_every=2)
    assert len(asked) == at + again
    assert stopped.read_bytes() == whole.read_bytes()
    assert (tmp_path / "stopped" / CURVE).is_file()


def test_what_other_eyes_learned_last_is_not_gone_on_with(
    pictures: Pictures, small_tower: Callable[[], Tower], tmp_path: Path
) -> None:
    settings = Training(updates=4, batch=4)
    alone = train(pictures, KINDS, tmp_path / "alone", settings, tower=small_tower, save_every=2)
    train(pictures, KINDS, tmp_path / "again", replace(settings, seed=1), tower=small_tower, save_every=2)
    (tmp_path / "again" / CHECKPOINT).unlink()
    again = train(pictures, KINDS, tmp_path / "again", settings, tower=small_tower, save_every=2)
    assert again.read_bytes() == alone.read_bytes()


def test_it_learns(pictures: Pictures, small_tower: Callable[[], Tower], tmp_path: Path) -> None:
    settings = Training(updates=60, batch=4, rate=1e-2)
    train(pictures, KINDS, tmp_path / "run", settings, tower=small_tower, save_every=60)
    points = torch.load(tmp_path / "run" / CHECKPOINT, weights_only=True)["points"]
    assert len(points) == 6
    assert all(points[-1][name] < 0.8 * points[0][name] for name in points[0]), points
    assert {name.split()[0] for name in points[0]} == set(READINGS)


def test_every_weight_learns(pictures: Pictures, small_tower: Callable[[], Tower], tmp_path: Path) -> None:
    settings = Training(updates=3, batch=4)
    train(pictures, KINDS, tmp_path, settings, tower=small_tower)
    learned = torch.load(tmp_path / CHECKPOINT, weights_only=True)["eyes"]
    torch.manual_seed(settings.seed)
    first = dict(Eyes(small_tower(), KINDS).named_parameters())
    same = {name for name, value in first.items() if torch.equal(value, learned[name])}
    assert {name.rpartition(".")[0] for name in same} == LEARNED_LAST, "only what is learned last"


def test_what_is_learned_last_fits_and_changes_nothing_else(
    pictures: Pictures, small_tower: Callable[[], Tower], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "DOUBT_RATE", 0.1)
    monkeypatch.setattr(training, "SURE_RATE", 3e-4)  # quicker, it learns twelve pictures by heart, and is too sure
    settings = Training(updates=30, batch=12, rate=1e-2)
    eyes = load_eyes(train(pictures, KINDS, tmp_path / "run", settings, tower=small_tower, save_every=30))
    before = {name: value.clone() for name, value in eyes.state_dict().items()}
    learn_last(eyes, pictures, Training(updates=150, batch=12))
    changed_ones = {name for name, value in eyes.state_dict().items() if not torch.equal(value, before[name])}
    assert {name.rpartition(".")[0] for name in changed_ones} == LEARNED_LAST
    rows = pictures.rows(np.arange(12))
    wanted = targets(rows, len(KINDS), *CELLS["fine"])
    with torch.inference_mode():
        learned = eyes.find(images_of(rows))
        doubt, sure = learned.doubt, learned.sure
        assert doubt is not None
        assert sure is not None
        for times in (0.5, 2.0):
            other = replace(learned, doubt=lambda *cells, more=times: doubt(*cells) + np.log(more))
            assert doubt_loss(learned, wanted) < doubt_loss(other, wanted), "as large as errors are"
        for more in (-1.0, 1.0):
            other = replace(learned, sure=lambda *cells, more=more: sure(*cells) + more)
            assert sure_loss(learned, wanted) < sure_loss(other, wanted), "as sure as finds are right"
    monkeypatch.undo()
    learn_last(eyes, pictures, Training(updates=150, batch=12))
    with torch.inference_mode():
        learned = eyes.find(images_of(rows))
        sure = learned.sure
        assert sure is not None
        for same in np.linspace(-6, 0, 13):
            other = replace(learned, sure=lambda *cells, same=same: torch.full_like(sure(*cells), same))
            assert 5 * sure_loss(learned, wanted) < sure_loss(other, wanted), "right finds are told from wrong ones"


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
