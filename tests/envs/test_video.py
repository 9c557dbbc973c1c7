"""Videos are complete or absent and contain the end of the episode; cached text equals freshly drawn text."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest

from lerobot_memobench.constants import EXECUTION, PROMPT
from lerobot_memobench.envs.video import BAND, LAST_FRAMES, MARGIN, OPERATION_COLOURS, VideoRecorder, annotate
from lerobot_memobench.tasks.catalogue import get_task

STOVE = "turn_on_the_stove_and_turn_it_off"


def frame(value: int) -> np.ndarray:
    return np.full((64, 128, 3), value, dtype=np.uint8)


def encoded_directly(path: Path, frames: list[np.ndarray]) -> bytes:
    container = av.open(str(path), "w", format="mp4")
    stream = container.add_stream("libx264", rate=20, options={"preset": "ultrafast", "crf": "20", "threads": "1"})
    stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], "yuv420p"
    for image in [*frames, *[frames[-1]] * LAST_FRAMES]:
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
    container.mux(stream.encode())
    container.close()
    return path.read_bytes()


@pytest.mark.parametrize(("count", "width"), [(3, 100), (20, 128)])
def test_video_equals_direct_encoding(tmp_path: Path, count: int, width: int) -> None:
    """The caller reuses one buffer; 100 pixels are no multiple of the padding."""
    noise = np.random.default_rng(0).integers(0, 256, (2, count, 64, width, 3), np.uint8)
    recorders = [VideoRecorder(tmp_path / "videos" / f"task.{number}.mp4") for number in range(2)]
    buffer = np.empty((64, width, 3), np.uint8)
    for images in noise.swapaxes(0, 1):
        for recorder, image in zip(recorders, images, strict=True):
            buffer[:] = image
            recorder.add(buffer)
    buffer[:] = 0
    assert not list(tmp_path.rglob("task*.mp4"))
    for number, (recorder, images) in enumerate(zip(recorders, noise, strict=True)):
        path = recorder.finish()
        assert path == tmp_path / "videos" / f"task.{number}.mp4"
        assert path.read_bytes() == encoded_directly(tmp_path / "direct.mp4", list(images))
    assert len(list((tmp_path / "videos").iterdir())) == 2


def test_unfinished_and_empty_videos_leave_no_file(tmp_path: Path) -> None:
    recorder = VideoRecorder(tmp_path / "task.0.mp4")
    recorder.add(frame(10))
    with pytest.raises(ValueError, match="shape"):
        recorder.add(np.zeros((32, 128, 3), np.uint8))
    recorder.discard()
    assert VideoRecorder(tmp_path / "empty.mp4").finish() is None
    assert list(tmp_path.iterdir()) == []


# --- text over the images ---


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


def has_colour(image: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((image == colour).all(axis=2).any())


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
