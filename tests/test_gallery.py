"""Figures: everything is on them, and they stay small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFont

from tests.support.scripts import load_script

gallery = load_script("gallery")

STOVE = "turn_on_the_stove_and_turn_it_off"
BOWLS = "put_the_butter_into_the_bowl_from_the_prompt_video"


def test_grid_has_room_for_every_picture() -> None:
    cells = [(f"picture {k}", np.full((40, 60, 3), 10 * k, np.uint8)) for k in range(5)]
    sheet = np.asarray(gallery.grid(cells, 2))
    for k in range(5):
        assert (sheet == 10 * k).all(axis=2).sum() >= 40 * 60


def test_long_labels_are_wrapped_and_not_cut() -> None:
    picture = np.full((40, 60, 3), 200, np.uint8)
    short, long = (gallery.grid([(text, picture)], 1, label=10) for text in ("plate", "put the milk on the plate"))
    assert long.width == short.width
    assert long.height > short.height + 10
    wrapped = gallery._wrapped("put the milk on the plate", ImageFont.load_default(10), 60)
    assert " ".join(wrapped) == "put the milk on the plate"
    assert max(ImageFont.load_default(10).getlength(line) for line in wrapped) <= 60


def test_tasks_stand_under_their_memory_type() -> None:
    one = gallery.draw_tasks([STOVE], size=64)
    two = gallery.draw_tasks([STOVE, BOWLS], size=64)
    assert (one.width, two.width) == (64 + 12, 64 + 12)
    assert two.height > 2 * one.height - 20


def test_figures_are_shrunk_until_they_are_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gallery, "LARGEST_FILE", 8_000)
    noise = np.random.default_rng(0).integers(0, 255, (120, 120, 3), dtype=np.uint8)
    path = gallery.save(Image.fromarray(noise), tmp_path / "deep" / "noise.png")
    assert path.stat().st_size <= 8_000
    assert Image.open(path).width < 120
    plain = gallery.save(Image.new("RGB", (300, 300)), tmp_path / "plain.png")
    assert Image.open(plain).size == (300, 300)


def test_sheets() -> None:
    objects = gallery.draw_objects(["butter", "milk"], size=32)
    assert objects.width == 2 * 4 * 32 + 18
    closed_and_open = np.asarray(gallery.draw_fixtures(["microwave"], size=64)).astype(int)
    left, right = closed_and_open[6:70, 6:70], closed_and_open[6:70, 140:204]
    assert np.abs(left - right).mean() > 5
