"""`scripts/gallery.py`: sheets show all pictures, and files stay small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFont

from lerobot_memobench.sim.simulation import RenderSettings
from lerobot_memobench.tasks.catalogue import task_names
from lerobot_memobench.tasks.task import Task
from tests.support.scripts import load_script

gallery = load_script("gallery")


def test_grid_shows_every_picture() -> None:
    cells = [(f"picture {k}", np.full((40, 60, 3), 10 * k, np.uint8)) for k in range(5)]
    sheet = np.asarray(gallery.grid(cells, 2))
    for k in range(5):
        assert (sheet == 10 * k).all(axis=2).sum() >= 40 * 60


def test_long_labels_are_wrapped() -> None:
    picture, text = np.full((40, 60, 3), 200, np.uint8), "put the milk on the plate"
    short, long = (gallery.grid([(label, picture)], 1, label=10) for label in ("plate", text))
    assert (long.width, long.height > short.height + 10) == (short.width, True)
    font = ImageFont.load_default(10)
    lines = gallery._wrapped(text, font, 60)
    assert " ".join(lines) == text
    assert max(font.getlength(line) for line in lines) <= 60


def test_tasks_are_drawn_at_the_places_of_the_layout(monkeypatch: pytest.MonkeyPatch) -> None:
    """`docs_reference` crops the pictures of task cards at these places."""
    names = [*task_names()[:7], *task_names()[-2:]]

    class FakeSimulation:
        def __init__(self, task: Task, render: RenderSettings) -> None:
            self.image = np.full((render.height, render.width, 3), 10 * names.index(task.name), np.uint8)

        def reset(self, seed: int) -> None: ...

        def render(self, camera: str) -> np.ndarray:
            return self.image

    monkeypatch.setattr(gallery, "Simulation", FakeSimulation)
    sheet = np.asarray(gallery.draw_tasks(names, size=64))
    for name, (x, y) in gallery.task_places(names, size=64).items():
        assert (sheet[y : y + 64, x : x + 64] == 10 * names.index(name)).all(), name


def test_figures_are_reduced_to_the_maximum_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gallery, "LARGEST_FILE", 8_000)
    noise = np.random.default_rng(0).integers(0, 255, (120, 120, 3), dtype=np.uint8)
    path = gallery.save(Image.fromarray(noise), tmp_path / "new" / "noise.png")
    assert path.stat().st_size <= 8_000
    assert Image.open(path).width < 120
    assert Image.open(gallery.save(Image.new("RGB", (300, 300)), tmp_path / "plain.png")).size == (300, 300)
