"""A film is whole or not there, and shows the episode's end."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from lerobot_memobench.envs.film import LAST_FRAMES, Film


def frame(value: int) -> np.ndarray:
    return np.full((64, 128, 3), value, dtype=np.uint8)


def test_a_film_appears_when_it_is_finished(tmp_path: Path) -> None:
    film = Film(tmp_path / "videos" / "task.0.mp4")
    for value in (0, 100, 200):
        film.add(frame(value))
    assert not (tmp_path / "videos" / "task.0.mp4").exists()
    assert film.finish() == tmp_path / "videos" / "task.0.mp4"
    with av.open(str(tmp_path / "videos" / "task.0.mp4")) as container:
        means = [picture.to_ndarray(format="rgb24").mean() for picture in container.decode(video=0)]
    assert len(means) == 3 + LAST_FRAMES
    assert np.abs(np.array(means[-LAST_FRAMES:]) - 200).max() < 4
    assert [path.name for path in (tmp_path / "videos").iterdir()] == ["task.0.mp4"]


def test_an_unfinished_film_leaves_nothing(tmp_path: Path) -> None:
    film = Film(tmp_path / "task.0.mp4")
    film.add(frame(10))
    film.discard()
    assert list(tmp_path.iterdir()) == []
    assert Film(tmp_path / "empty.mp4").finish() is None
