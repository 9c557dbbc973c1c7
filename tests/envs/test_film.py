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


def test_a_film_shows_each_frame_as_it_was_when_added(tmp_path: Path) -> None:
    """One buffer serves all frames; 100 pixels are no multiple of what a video library pads its lines to."""
    film, shown = Film(tmp_path / "task.0.mp4"), np.zeros((64, 100, 3), np.uint8)
    for value in (0, 60, 120, 180):
        shown[:, value // 3 : value // 3 + 10] = value
        film.add(shown)
    film.finish()
    shown[:] = 255  # the caller's own again
    with av.open(str(tmp_path / "task.0.mp4")) as container:
        pictures = [picture.to_ndarray(format="rgb24") for picture in container.decode(video=0)]
    assert [picture.shape for picture in pictures[:1]] == [(64, 100, 3)]
    for number, value in enumerate((0, 60, 120, 180)):
        assert abs(pictures[number][20:40, value // 3 + 4].mean() - value) < 12
        assert pictures[number][:, 99].mean() < 12
    assert abs(pictures[-1][20:40, 64].mean() - 180) < 12
