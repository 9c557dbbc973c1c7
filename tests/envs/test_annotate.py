"""The text over a film's pictures: what is kept from frame to frame looks as if all of it were drawn each time."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.envs import video
from lerobot_memobench.envs.video import BAND, OPERATION_COLOURS, annotate
from lerobot_memobench.protocol import EXECUTION, PROMPT
from lerobot_memobench.tasks.catalogue import get_task, task_names

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
    now = "watch the prompt" if prompt else "done" if episode.success else episode.subgoal()
    text, font = fitted(draw, now, width - x - 14)
    draw.text((x + 6, 44), text, fill=PURPLE if prompt else TEXT, font=font, anchor="lm")
    return np.vstack([np.asarray(band), pictures])


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
