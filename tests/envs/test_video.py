"""Videos are complete or absent and contain the end of the episode; cached text equals freshly drawn text."""

from __future__ import annotations

import dataclasses
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from PIL import ImageDraw

from lerobot_memobench.envs import video
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.video import AHEAD, BAND, LAST_FRAMES, MARGIN, OPERATION_COLOURS, VideoRecorder, annotate
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import EXECUTION, PROMPT
from lerobot_memobench.tasks.catalogue import get_task, task_names

STOVE = "turn_on_the_stove_and_turn_it_off"


def frame(value: int) -> np.ndarray:
    return np.full((64, 128, 3), value, dtype=np.uint8)


def encoded_directly(path: Path, frames: list[np.ndarray]) -> bytes:
    container = av.open(str(path), "w", format="mp4")
    stream = container.add_stream("libx264", rate=20, options={"preset": "ultrafast", "crf": "20", "threads": "1"})
    stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], "yuv420p"
    for picture in [*frames, *[frames[-1]] * LAST_FRAMES]:
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    container.mux(stream.encode())
    container.close()
    return path.read_bytes()


@pytest.mark.parametrize(("count", "width"), [(1, 128), (AHEAD + 1, 100), (20, 128)])
def test_video_equals_direct_encoding(tmp_path: Path, count: int, width: int) -> None:
    """Two recorders share the thread; the caller reuses one buffer; 100 pixels are no multiple of the padding."""
    noise = np.random.default_rng(0).integers(0, 256, (2, count, 64, width, 3), np.uint8)
    recorders = [VideoRecorder(tmp_path / "videos" / f"task.{number}.mp4") for number in range(2)]
    buffer = np.empty((64, width, 3), np.uint8)
    for pictures in noise.swapaxes(0, 1):
        for recorder, picture in zip(recorders, pictures, strict=True):
            buffer[:] = picture
            recorder.add(buffer)
    buffer[:] = 0
    assert not list(tmp_path.rglob("task*.mp4"))
    for number, (recorder, pictures) in enumerate(zip(recorders, noise, strict=True)):
        path = recorder.finish()
        assert path == tmp_path / "videos" / f"task.{number}.mp4"
        assert path.read_bytes() == encoded_directly(tmp_path / "direct.mp4", list(pictures))
    assert len(list((tmp_path / "videos").iterdir())) == 2


def test_unfinished_and_empty_videos_leave_no_file(tmp_path: Path) -> None:
    recorder = VideoRecorder(tmp_path / "task.0.mp4")
    recorder.add(frame(10))
    with pytest.raises(ValueError, match="shape"):
        recorder.add(np.zeros((32, 128, 3), np.uint8))
    recorder.discard()
    assert VideoRecorder(tmp_path / "empty.mp4").finish() is None
    assert list(tmp_path.iterdir()) == []


def test_adding_waits_for_the_encoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory stays bounded; discarding skips the waiting frames."""
    begun, go_on, encoded = threading.Event(), threading.Event(), []

    def encode(self: VideoRecorder, picture: av.VideoFrame) -> None:
        encoded.append(picture)
        begun.set()
        go_on.wait(60)

    monkeypatch.setattr(VideoRecorder, "_encode", encode)
    recorder = VideoRecorder(tmp_path / "task.0.mp4")
    for value in range(AHEAD):
        recorder.add(frame(value))
    adding = threading.Thread(target=recorder.add, args=(frame(AHEAD),))
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
    yield Path("/dev/full")


def add_often(recorder: VideoRecorder, picture: np.ndarray) -> None:
    for _ in range(9):
        recorder.add(picture)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_unwritable_video_raises_and_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (320, 512, 3), np.uint8)  # exceeds the encoder's buffer
    monkeypatch.setattr(video, "draft_of", on_a_full_disk)
    recorder = VideoRecorder(tmp_path / "task.0.mp4")
    with pytest.raises(MemobenchError, match=r"task\.0\.mp4.*No space left on device"):
        add_often(recorder, noise)
    with pytest.raises(MemobenchError, match="No space left"):
        recorder.finish()
    recorder.discard()
    monkeypatch.undo()
    (tmp_path / "file").touch()
    recorder = VideoRecorder(tmp_path / "file" / "task.1.mp4")
    recorder.add(noise)
    with pytest.raises(MemobenchError, match=r"task\.1\.mp4"):
        recorder.finish()
    recorder.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# --- text over the pictures ---


def moment(name: str, phase: int = EXECUTION, step: int = 0, done: int = 0, **changes: Any) -> SimpleNamespace:
    task = dataclasses.replace(get_task(name), **changes)
    texts = [checkpoint.language[1] for checkpoint in task.checkpoints]
    return SimpleNamespace(
        task=task,
        phase=phase,
        step_index=step,
        exec_steps=step,
        progress=SimpleNamespace(index=done),
        success=done == len(texts),
        subgoal=lambda: texts[min(done, len(texts) - 1)],
    )


def has_colour(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((picture == colour).all(axis=2).any())


def test_frame_shows_cameras_checkpoints_and_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    images = {camera: rng.integers(0, 256, (128, 128, 3), np.uint8) for camera in ("image", "wrist_image")}
    first, second = ([*range(MARGIN, MARGIN + 20)], [*range(MARGIN + 26, MARGIN + 46)])
    operations = [checkpoint.operation for checkpoint in get_task(STOVE).checkpoints]
    filled = []
    for done in range(3):
        found = annotate(images, moment(STOVE, done=done))  # type: ignore[arg-type]
        assert found.shape == (BAND + 128, 256, 3)
        np.testing.assert_array_equal(found[BAND:], np.hstack(list(images.values())))
        for operation, place in zip(operations, (first, second), strict=True):
            assert has_colour(found[34:55, place], OPERATION_COLOURS[operation])
        filled.append(
            [
                bool((found[52, place[4]] == OPERATION_COLOURS[op]).all())
                for op, place in zip(operations, (first, second), strict=True)
            ]
        )
    assert filled == [[False, False], [True, False], [True, True]]
    prompt = annotate(images, moment(STOVE, PROMPT, 9, done=1))  # type: ignore[arg-type]
    assert not (prompt[52, first[4]] == OPERATION_COLOURS[operations[0]]).all(), "no checkpoint is done in a prompt"
    assert has_colour(prompt, (204, 121, 167))
    assert [Episode.subgoal(moment(STOVE, done=k)) for k in range(3)] == [  # type: ignore[arg-type]
        "switch the stove on",
        *["switch the stove off again"] * 2,
    ]


def test_cached_text_equals_drawn_text_and_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    images = {"image": np.zeros((2, 512, 3), np.uint8)}
    moments = [
        moment(name, phase, step, done)
        for name in task_names()[::12]
        for phase in (PROMPT, EXECUTION)
        for step in (0, 9, 444, 1200)
        for done in (0, 1)
    ]
    cached = [annotate(images, each) for each in moments]  # type: ignore[arg-type]
    for each, expected in zip(moments, cached, strict=True):
        video._band.cache_clear()
        video._piece.cache_clear()
        np.testing.assert_array_equal(annotate(images, each), expected)  # type: ignore[arg-type]
    assert len({picture.tobytes() for picture in cached}) > len(moments) / 2
    drawn: list[str] = []
    draw = ImageDraw.ImageDraw.text

    def text(self: ImageDraw.ImageDraw, place: object, words: str, *args: object, **settings: object) -> None:
        drawn.append(words)
        draw(self, place, words, *args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    video._piece.cache_clear()
    for step in (123_456, 123_457, 123_456):
        annotate(images, moment(STOVE, step=step, language="drawn in this test only"))  # type: ignore[arg-type]
    assert max(Counter(drawn).values()) == 1
    assert {"drawn in this test only", "step ", "7"} < {*drawn}
