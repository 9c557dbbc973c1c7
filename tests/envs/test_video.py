"""A film is whole or not there, and shows the episode's end."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import numpy as np
import pytest

from lerobot_memobench.envs import video
from lerobot_memobench.envs.video import AHEAD, LAST_FRAMES, VideoRecorder
from lerobot_memobench.errors import MemobenchError


def frame(value: int) -> np.ndarray:
    return np.full((64, 128, 3), value, dtype=np.uint8)


def test_a_film_appears_when_it_is_finished(tmp_path: Path) -> None:
    film = VideoRecorder(tmp_path / "videos" / "task.0.mp4")
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
    film = VideoRecorder(tmp_path / "task.0.mp4")
    film.add(frame(10))
    film.discard()
    assert list(tmp_path.iterdir()) == []
    assert VideoRecorder(tmp_path / "empty.mp4").finish() is None


def test_a_film_shows_each_frame_as_it_was_when_added(tmp_path: Path) -> None:
    """One buffer serves all frames; 100 pixels are no multiple of what a video library pads its lines to."""
    film, shown = VideoRecorder(tmp_path / "task.0.mp4"), np.zeros((64, 100, 3), np.uint8)
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


def encoded_directly(path: Path, frames: list[np.ndarray]) -> bytes:
    """One frame after the other, in the caller's thread."""
    container = av.open(str(path), "w", format="mp4")
    stream = container.add_stream("libx264", rate=20, options={"preset": "ultrafast", "crf": "20", "threads": "1"})
    stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], "yuv420p"
    for picture in [*frames, *[frames[-1]] * LAST_FRAMES]:
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    container.mux(stream.encode())
    container.close()
    return path.read_bytes()


@pytest.mark.parametrize("count", [1, AHEAD, AHEAD + 1, 40])
def test_films_are_those_that_are_encoded_directly(tmp_path: Path, count: int) -> None:
    """Two at once share the thread."""
    noise = np.random.default_rng(0).integers(0, 256, (2, count, 64, 128, 3), np.uint8)
    films = [VideoRecorder(tmp_path / f"task.{number}.mp4") for number in range(2)]
    for pictures in noise.swapaxes(0, 1):
        for film, picture in zip(films, pictures, strict=True):
            film.add(picture)
    for film, pictures in zip(films, noise, strict=True):
        path = film.finish()
        assert path is not None
        assert path.read_bytes() == encoded_directly(tmp_path / "direct.mp4", list(pictures))


def test_frames_wait_for_the_encoder_when_it_is_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is in memory stays bounded, and discarding does not encode what waits."""
    begun, go_on, encoded = threading.Event(), threading.Event(), []

    def encode(self: VideoRecorder, picture: av.VideoFrame) -> None:
        encoded.append(picture)
        begun.set()
        go_on.wait(60)

    monkeypatch.setattr(VideoRecorder, "_encode", encode)
    film = VideoRecorder(tmp_path / "task.0.mp4")
    for value in range(AHEAD):
        film.add(frame(value))
    adding = threading.Thread(target=film.add, args=(frame(AHEAD),))
    adding.start()
    begun.wait()
    adding.join(0.05)
    assert adding.is_alive()
    go_on.set()
    adding.join()
    assert len({id(picture) for picture in encoded}) <= AHEAD

    begun.clear()
    go_on.clear()
    other = VideoRecorder(tmp_path / "task.1.mp4")
    for value in range(AHEAD):
        other.add(frame(value))
    begun.wait()
    count = len(encoded)
    threading.Timer(0.05, go_on.set).start()
    other.discard()
    assert len(encoded) == count
    assert list(tmp_path.iterdir()) == []


@contextmanager
def on_a_full_disk(path: Path) -> Iterator[Path]:
    """A draft that takes no byte."""
    yield Path("/dev/full")


def add_often(film: VideoRecorder, picture: np.ndarray) -> None:
    for _ in range(9):
        film.add(picture)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full disk to offer")
def test_what_cannot_be_written_is_told_and_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (320, 512, 3), np.uint8)  # more than is kept back for later
    monkeypatch.setattr(video, "draft_of", on_a_full_disk)
    film = VideoRecorder(tmp_path / "task.0.mp4")
    with pytest.raises(MemobenchError, match=r"task\.0\.mp4 cannot be written \(No space left on device\); make room"):
        add_often(film, noise)
    with pytest.raises(MemobenchError, match="No space left"):
        film.finish()  # FFmpeg is handed nothing more: it would end the process
    film.discard()
    monkeypatch.undo()
    (tmp_path / "file").touch()
    film = VideoRecorder(tmp_path / "file" / "task.1.mp4")
    film.add(noise)
    with pytest.raises(MemobenchError, match=r"task\.1\.mp4 cannot be written"):
        film.finish()
    film.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    film = VideoRecorder(tmp_path / "task.0.mp4")
    film.add(frame(0))
    with pytest.raises(ValueError, match="shape"):
        film.add(np.zeros((32, 128, 3), np.uint8))
    film.discard()
    assert list(tmp_path.iterdir()) == []
