"""A video is whole or not there, and shows the end of its episode; the text over its pictures."""

from __future__ import annotations

import dataclasses
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.envs import video
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.video import AHEAD, BAND, LAST_FRAMES, OPERATION_COLOURS, VideoRecorder, annotate
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import EXECUTION, PROMPT
from lerobot_memobench.tasks.catalogue import get_task, task_names


def frame(value: int) -> np.ndarray:
    return np.full((64, 128, 3), value, dtype=np.uint8)


def test_a_video_appears_when_it_is_finished(tmp_path: Path) -> None:
    recorder = VideoRecorder(tmp_path / "videos" / "task.0.mp4")
    for value in (0, 100, 200):
        recorder.add(frame(value))
    assert not (tmp_path / "videos" / "task.0.mp4").exists()
    assert recorder.finish() == tmp_path / "videos" / "task.0.mp4"
    with av.open(str(tmp_path / "videos" / "task.0.mp4")) as container:
        means = [picture.to_ndarray(format="rgb24").mean() for picture in container.decode(video=0)]
    assert len(means) == 3 + LAST_FRAMES
    assert np.abs(np.array(means[-LAST_FRAMES:]) - 200).max() < 4
    assert [path.name for path in (tmp_path / "videos").iterdir()] == ["task.0.mp4"]


def test_an_unfinished_video_leaves_nothing(tmp_path: Path) -> None:
    recorder = VideoRecorder(tmp_path / "task.0.mp4")
    recorder.add(frame(10))
    recorder.discard()
    assert list(tmp_path.iterdir()) == []
    assert VideoRecorder(tmp_path / "empty.mp4").finish() is None


def test_a_video_shows_each_frame_as_it_was_when_added(tmp_path: Path) -> None:
    """One buffer serves all frames; 100 pixels are no multiple of what a video library pads its lines to."""
    recorder, shown = VideoRecorder(tmp_path / "task.0.mp4"), np.zeros((64, 100, 3), np.uint8)
    for value in (0, 60, 120, 180):
        shown[:, value // 3 : value // 3 + 10] = value
        recorder.add(shown)
    recorder.finish()
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
def test_videos_are_those_that_are_encoded_directly(tmp_path: Path, count: int) -> None:
    """Two at once share the thread."""
    noise = np.random.default_rng(0).integers(0, 256, (2, count, 64, 128, 3), np.uint8)
    recorders = [VideoRecorder(tmp_path / f"task.{number}.mp4") for number in range(2)]
    for pictures in noise.swapaxes(0, 1):
        for recorder, picture in zip(recorders, pictures, strict=True):
            recorder.add(picture)
    for recorder, pictures in zip(recorders, noise, strict=True):
        path = recorder.finish()
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
    """A draft that takes no byte."""
    yield Path("/dev/full")


def add_often(recorder: VideoRecorder, picture: np.ndarray) -> None:
    for _ in range(9):
        recorder.add(picture)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full disk to offer")
def test_what_cannot_be_written_is_told_and_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (320, 512, 3), np.uint8)  # more than is kept back for later
    monkeypatch.setattr(video, "draft_of", on_a_full_disk)
    recorder = VideoRecorder(tmp_path / "task.0.mp4")
    with pytest.raises(MemobenchError, match=r"task\.0\.mp4 cannot be written \(No space left on device\); make room"):
        add_often(recorder, noise)
    with pytest.raises(MemobenchError, match="No space left"):
        recorder.finish()  # FFmpeg is handed nothing more: it would end the process
    recorder.discard()
    monkeypatch.undo()
    (tmp_path / "file").touch()
    recorder = VideoRecorder(tmp_path / "file" / "task.1.mp4")
    recorder.add(noise)
    with pytest.raises(MemobenchError, match=r"task\.1\.mp4 cannot be written"):
        recorder.finish()
    recorder.discard()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    recorder = VideoRecorder(tmp_path / "task.0.mp4")
    recorder.add(frame(0))
    with pytest.raises(ValueError, match="shape"):
        recorder.add(np.zeros((32, 128, 3), np.uint8))
    recorder.discard()
    assert list(tmp_path.iterdir()) == []


# --- the text over the pictures: kept from frame to frame, it looks as if all of it were drawn each time ---

BACKGROUND, TEXT, FAINT, PURPLE = (24, 26, 30), (240, 240, 240), (150, 155, 165), (204, 121, 167)


load_font = cache(ImageFont.load_default)


def fitted(draw: ImageDraw.ImageDraw, text: str, width: int) -> tuple[str, ImageFont.FreeTypeFont]:
    for points in range(14, 8, -1):
        font = load_font(size=points)
        if draw.textlength(text, font=font) <= width:
            return text, font
    font = load_font(size=9)
    while text and draw.textlength(text + "…", font=font) > width:
        text = text[:-1]
    return text + "…", font


def drawn_anew(images: dict[str, np.ndarray], episode: SimpleNamespace) -> np.ndarray:
    """The whole frame, nothing kept."""
    pictures = np.hstack(list(images.values()))
    width = pictures.shape[1]
    band = Image.new("RGB", (width, BAND), BACKGROUND)
    draw = ImageDraw.Draw(band)
    prompt = episode.phase == PROMPT
    text, font = fitted(draw, episode.task.language, width - 96)
    draw.text((8, 5), text, fill=TEXT, font=font)
    clock = ("prompt ", *str(episode.step_index)) if prompt else ("step ", *str(episode.exec_steps))
    font = load_font(size=13)
    x = width - 8 - sum(round(font.getlength(piece)) for piece in clock)
    for piece in clock:
        draw.text((x, 5), piece, fill=PURPLE if prompt else FAINT, font=font)
        x += round(font.getlength(piece))
    x = 8
    for index, checkpoint in enumerate(episode.task.checkpoints):
        colour, done = OPERATION_COLOURS[checkpoint.operation], index < episode.progress.index and not prompt
        draw.rounded_rectangle((x, 34, x + 20, 54), 4, fill=colour if done else None, outline=colour, width=2)
        if done:
            draw.line([(x + 5, 44), (x + 9, 49), (x + 16, 39)], fill=BACKGROUND, width=3)
        else:
            font = load_font(size=12)
            draw.text((x + 10, 44), checkpoint.operation, fill=colour, font=font, anchor="mm")
        x += 26
    now = "watch the prompt" if prompt else "done" if episode.success else f"next: {episode.subgoal()}"
    text, font = fitted(draw, now, width - x - 14)
    draw.text((x + 6, 44), text, fill=PURPLE if prompt else TEXT, font=font, anchor="lm")
    return np.vstack([np.asarray(band), pictures])


def test_what_is_next_is_an_instruction() -> None:
    task = get_task("turn_on_the_stove_and_turn_it_off")
    found: list[Any] = [SimpleNamespace(task=task, progress=SimpleNamespace(index=index)) for index in range(3)]
    told = [Episode.subgoal(moment) for moment in found]
    assert told == ["switch the stove on", *["switch the stove off again"] * 2]


def moments(name: str) -> Iterator[SimpleNamespace]:
    """An episode that shows its prompt, completes one checkpoint after the other and succeeds."""
    task = get_task(name)
    count = len(task.checkpoints)

    def moment(phase: int, step: int, done: int) -> SimpleNamespace:
        subgoal = task.checkpoints[min(done, count - 1)].language[1] if count else task.language
        return SimpleNamespace(
            task=task,
            phase=phase,
            step_index=step,
            exec_steps=step,
            progress=SimpleNamespace(index=done),
            success=done == count,
            subgoal=lambda: subgoal,
        )

    yield from (moment(PROMPT, step, done) for step in (0, 9, 444, 1000) for done in (0, 1))
    yield from (moment(EXECUTION, 111 * done + step, done) for done in range(count + 1) for step in (0, 1, 8))


@pytest.mark.parametrize("size", [128, 256])
def test_what_is_kept_looks_as_if_drawn_anew(size: int) -> None:
    rng = np.random.default_rng(0)
    for name in task_names()[::12]:
        images = {camera: rng.integers(0, 256, (size, size, 3), np.uint8) for camera in ("image", "wrist_image")}
        for episode in moments(name):
            np.testing.assert_array_equal(annotate(images, episode), drawn_anew(images, episode))


def test_every_clock_is_the_one_drawn() -> None:
    (first, *_), images = list(moments(task_names()[0])), {"image": np.zeros((2, 512, 3), np.uint8)}
    for phase, last in ((PROMPT, 1000), (EXECUTION, 1200)):
        for step in range(0, last + 1, 13):
            episode = SimpleNamespace(**{**vars(first), "phase": phase, "step_index": step, "exec_steps": step})
            np.testing.assert_array_equal(annotate(images, episode), drawn_anew(images, episode))


def test_what_does_not_change_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    draw = video.ImageDraw.ImageDraw.text

    def text(self: ImageDraw.ImageDraw, place: object, words: str, *args: object, **settings: object) -> None:
        drawn.append(words)
        draw(self, place, words, *args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(video.ImageDraw.ImageDraw, "text", text)
    task = dataclasses.replace(get_task(task_names()[0]), language="said in this test alone")
    (*_, last), images = list(moments(task.name)), {"image": np.zeros((2, 512, 3), np.uint8)}
    video._piece.cache_clear()
    for step in (123_456, 123_457, 123_456):
        annotate(images, SimpleNamespace(**{**vars(last), "task": task, "exec_steps": step}))
    assert drawn.count(task.language) == 1
    assert max(Counter(drawn).values()) == 1
    assert {"step ", "7"} < {*drawn}
